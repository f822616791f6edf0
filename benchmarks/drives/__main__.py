"""Write a simulated drive as a COLMAP model.

python -m benchmarks.drives PRESET DIR
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from benchmarks.drives.presets import PRESETS
from benchmarks.drives.write_drive import write_drive
from benchmarks.machine import describe_machine


def main() -> None:
    """Write the model and print what it cost."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("preset", choices=list(PRESETS))
    parser.add_argument("dir", type=Path)
    arguments = parser.parse_args()
    preset = PRESETS[arguments.preset]
    started = time.process_time()
    write_drive(preset, arguments.dir)
    size_gb = sum(path.stat().st_size for path in arguments.dir.glob("*.bin")) / 1e9
    print(describe_machine())
    print(f"{preset}: {size_gb:.2f} GB in {time.process_time() - started:.0f} CPU-s")


if __name__ == "__main__":
    main()
