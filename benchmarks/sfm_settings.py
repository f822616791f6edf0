"""Compare features and mapping strategies on one set of images: registered images, CPU time, error against true poses.

    python -m benchmarks.sfm_settings IMAGES [--rig FILE] [--truth FILE] --set extractor=colmap --set first_octave=-1
    python -m benchmarks.sfm_settings IMAGES --set strategies=global

`--truth` is a JSON list of objects with `image` and `C` (projection centre in metres), as in sample_data/street.
"""

from __future__ import annotations

import argparse
import json
import platform
import resource
import tempfile
import time
from pathlib import Path

import numpy as np
import pycolmap

from app.capture.capture import capture
from app.capture.options import CaptureOptions
from app.config import RunConfig, update_config
from app.sfm.stage import run_sfm


def cpu_seconds() -> float:
    """User and system time of this process and its finished children."""
    return sum(
        usage.ru_utime + usage.ru_stime
        for usage in map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    )


def position_errors(model: pycolmap.Reconstruction, truth: dict[str, list[float]]) -> dict[str, float]:
    """Distances to the true positions after the best similarity, and that similarity's scale."""
    images = [model.image(image_id) for image_id in model.reg_image_ids()]
    images = [image for image in images if image.name in truth]
    source = np.array([image.projection_center() for image in images])
    target = np.array([truth[image.name] for image in images])
    found = pycolmap.estimate_sim3d(source, target)
    if found is None:
        return {}
    errors_m = np.linalg.norm(np.array([found * center for center in source]) - target, axis=1)
    return {
        "median_m": round(float(np.median(errors_m)), 4),
        "p95_m": round(float(np.percentile(errors_m, 95)), 4),
        "scale": round(float(found.scale), 4),
    }


def main() -> None:
    """Run once and print one line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("images", type=Path)
    parser.add_argument("--rig", type=Path)
    parser.add_argument("--gps", type=Path)
    parser.add_argument("--truth", type=Path)
    parser.add_argument("--set", action="append", default=[], metavar="OPTION=VALUE", help="an option of the sfm stage")
    arguments = parser.parse_args()
    values: dict[str, object] = {}
    for setting in arguments.set:
        name, _, text = setting.partition("=")
        try:
            values[name] = json.loads(text)
        except ValueError:
            values[name] = text.split(",") if name == "strategies" else text
    options = update_config(RunConfig(), {"sfm": values}, where="--set").sfm
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        (work / "capture").mkdir()
        inventory = capture(
            arguments.images,
            work / "capture",
            options=CaptureOptions(),
            gps_file=arguments.gps,
            rig_file=arguments.rig,
        )
        start, start_cpu = time.monotonic(), cpu_seconds()
        report = run_sfm(inventory, work / "sfm", options=options)
        result: dict[str, object] = {
            "images": str(arguments.images),
            "options": values,
            "registered": f"{report.registered}/{report.images}",
            "used": report.used,
            "with_rig": [attempt.with_rig for attempt in report.attempts],
            "attempts": {attempt.strategy: attempt.components for attempt in report.attempts},
            "points": report.points,
            "observations": report.observations,
            "error_px": report.mean_reprojection_error_px,
            "cpu_s": round(cpu_seconds() - start_cpu, 1),
            "wall_s": round(time.monotonic() - start, 1),
            "pycolmap": pycolmap.__version__,
            "machine": platform.machine(),
        }
        if arguments.truth:
            truth = {entry["image"]: entry["C"] for entry in json.loads(arguments.truth.read_text(encoding="utf-8"))}
            result |= position_errors(pycolmap.Reconstruction(work / "sfm" / "model"), truth)
    print(json.dumps(result))


if __name__ == "__main__":
    main()
