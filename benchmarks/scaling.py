"""Time and memory of clustering and selection against the number of images, each model in a fresh process.

python -m benchmarks.scaling OUTPUT.json MODEL... [--workers 2] [--method optimal]

Kernels are compiled before, by a run on the first model that is not counted.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
from dataclasses import asdict
from pathlib import Path

from app.view_selection.options import SelectionMethod
from benchmarks.machine import describe_machine
from benchmarks.stage_run import run_stages


def main() -> None:
    """Print a row per model, and write them as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path)
    parser.add_argument("models", nargs="+", type=Path)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--method", type=SelectionMethod, default=SelectionMethod.OPTIMAL)
    arguments = parser.parse_args()
    print(describe_machine())
    print(f"selection {arguments.method} in {arguments.workers} processes")
    print("| images | clusters | cluster, CPU-s (wall) | select, CPU-s (wall) | CPU-ms per image | peak GiB |")
    print("|---|---|---|---|---|---|")
    rows = []
    for number, model in enumerate([arguments.models[0], *arguments.models]):
        folder = Path(tempfile.mkdtemp(prefix="scaling_", dir=arguments.output.parent))
        run = run_stages(model, folder, arguments.method, arguments.workers)
        report = json.loads((folder / "selection" / "report.json").read_text())
        shutil.rmtree(folder)
        if number == 0:
            continue
        num_images = report["num_images"]
        rows.append({"model": model.name, "num_images": num_images, **asdict(run)})
        arguments.output.write_text(json.dumps(rows, indent=1) + "\n")
        costs = " | ".join(f"{cost.cpu_s:.1f} ({cost.wall_s:.1f})" for cost in (run.clustering, run.selection))
        print(
            f"| {num_images:,} | {report['num_clusters']:,} | {costs} "
            f"| {1000 * run.cpu_s / num_images:.2f} | {run.peak_gib:.2f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
