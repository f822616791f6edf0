"""What a user waits for: `cityrecon cluster` and `cityrecon select` as commands, their start and end included.

python -m benchmarks.commands MODEL [--repeats 5]

Needs the program installed: the command `cityrecon` beside the interpreter. Compiled kernels are loaded from their
cache, after a run that isn't counted. MODEL is a COLMAP model with z up, in metres.
"""

from __future__ import annotations

import argparse
import json
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict
from pathlib import Path

from app.georegister.georeference import Georeference, GravitySource, ScaleSource
from app.stage import RECORD, StageRecord
from app.workspace import Workspace, remove_tree
from benchmarks.machine import describe_machine

COMMANDS: dict[str, tuple[str, ...]] = {
    "cluster": ("cluster",),
    "select": ("select",),
    "select without pictures": ("select", "--max-pictures", "0"),
}


def main() -> None:
    """Print the median of each command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path)
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    print(describe_machine())
    with tempfile.TemporaryDirectory() as scratch:
        workspace = Workspace(Path(scratch) / "workspace")
        _prepare(workspace, arguments.model.absolute())
        costs: dict[str, list[tuple[float, float]]] = {name: [] for name in COMMANDS}
        for _ in range(arguments.repeats + 1):
            for name, (command, *flags) in COMMANDS.items():
                remove_tree(workspace.root / {"cluster": "clusters", "select": "selection"}[command])
                workspace.config_file.write_text("")
                costs[name].append(_cost([command, str(workspace.root), *flags]))
        costs["--help"] = [_cost(["--help"]) for _ in range(arguments.repeats + 1)]
    for name, taken in costs.items():
        wall_s, cpu_s = (statistics.median(values) for values in zip(*taken[1:], strict=True))
        print(f"cityrecon {name}: {wall_s:.2f} s of wall time, {cpu_s:.2f} CPU-s (medians of {arguments.repeats})")


def _prepare(workspace: Workspace, model_dir: Path) -> None:
    """A workspace as the georegister stage leaves it."""
    folder = workspace.georegistered_model.parent
    folder.mkdir(parents=True)
    workspace.georegistered_model.symlink_to(model_dir)
    Georeference(
        crs="local",
        origin_deg_m=None,
        is_metric=True,
        scale_source=ScaleSource.OPTION,
        gravity_source=GravitySource.MODEL,
        gravity_sigma_deg=0.0,
    ).write(workspace.georeference_file)
    record = StageRecord(stage="georegister", options={}, inputs={}, product=str(model_dir), seconds=0.0)
    (folder / RECORD).write_text(json.dumps(asdict(record)))


def _cost(arguments: list[str]) -> tuple[float, float]:
    """Wall and CPU seconds of a command and its processes."""
    before, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    program = Path(sys.executable).with_name("cityrecon")
    subprocess.run([program, *arguments], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    wall_s, after = time.perf_counter() - started, resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall_s, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


if __name__ == "__main__":
    main()
