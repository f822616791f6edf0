"""One line of a table for each finished run.

python -m benchmarks.summary RUN.workspace=OUT.ply ...
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from app.capture.inventory import Inventory
from app.stage import RECORD
from benchmarks.machine import describe_machine
from fusion.cloud import read_ply_chunks


def main() -> None:
    """Print the table."""
    print(describe_machine(), end="\n\n")
    print("| set | registered | px | clusters | selected views | megapixels | points | minutes: sfm | densify | fuse |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for argument in sys.argv[1:]:
        workspace, cloud = (Path(part) for part in argument.split("="))
        print(_row(workspace, cloud))


def _row(workspace: Path, cloud: Path) -> str:
    inventory = Inventory.read(workspace / "capture" / "inventory.json")
    sfm = json.loads((workspace / "sfm" / "report.json").read_text(encoding="utf-8"))
    jobs = [json.loads(path.read_text(encoding="utf-8")) for path in sorted((workspace / "jobs").glob("*/job.json"))]
    pixels = sum(
        path.stat().st_size / 4 for path in workspace.glob("dense/*/stereo/depth_maps/**/*.bin")
    )  # 4 bytes per pixel, and a short header
    points = sum(len(chunk) for chunk in read_ply_chunks(cloud))
    minutes = [
        sum(json.loads(path.read_text(encoding="utf-8"))["seconds"] for path in workspace.glob(f"{stage}/{RECORD}"))
        / 60
        for stage in ("sfm", "dense/*", "fused/*")
    ]
    cells = [
        workspace.stem,
        f"{sfm['registered']}/{len(inventory.images)}",
        f"{sfm['mean_reprojection_error_px']:.2f}",
        str(len(jobs)),
        str(sum(len(job["images"]) for job in jobs)),
        f"{pixels / 1e6:.1f}",
        f"{points:,}",
        *(f"{value:.1f}" for value in minutes),
    ]
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    main()
