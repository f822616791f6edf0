"""Peak memory of the embedded stereo back-end for one large reference view and its source views.

    python -m benchmarks.patchmatch_memory WORK --megapixels 16

The views see a textured wall from places side by side, so each image is a cut-out of one texture, moved by a known
disparity. Sweeps are cut short: memory does not depend on their number. The first line, for a
tiny image, is what the program itself needs; with an empty NUMBA_CACHE_DIR it also shows how long compiling takes.
"""

from __future__ import annotations

import argparse
import dataclasses
import resource
import time
from pathlib import Path

import cv2
import numpy as np

from benchmarks.machine import describe_machine
from mvs_backends.base import MvsJob, MvsView, Preset
from mvs_backends.colmap_maps import read_map
from mvs_backends.patchmatch.backend import estimate_maps
from mvs_backends.patchmatch.options import PRESETS

_DEPTH_M, _SPACING_M = 10.0, 0.5


def main() -> None:
    """Print seconds and peak memory, small then large."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--megapixels", type=float, default=16.0)
    parser.add_argument("--preset", type=Preset, default=Preset.NORMAL)
    arguments = parser.parse_args()
    print(describe_machine())
    preset = PRESETS[arguments.preset]
    options = dataclasses.replace(preset, iterations=(1,) * len(preset.iterations), num_random=1)
    for megapixels in (0.02, arguments.megapixels):
        job = _job(arguments.work / f"{megapixels:g}", megapixels, options.num_source_views)
        started = time.perf_counter()
        estimate_maps(job=job, options=options, seed=0, num_threads=2)
        seconds = time.perf_counter() - started
        depth = read_map(job.depth_map_path(0))
        right = np.mean(np.abs(depth / _DEPTH_M - 1) < 0.01)
        peak_gib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        print(f"{megapixels:5g} MP: {seconds:6.1f} s, peak {peak_gib:.2f} GiB, {100 * right:.0f} % of the depth right")


def _job(folder: Path, megapixels: float, num_sources: int) -> MvsJob:
    width, height = round(np.sqrt(megapixels * 1e6 * 4 / 3)), round(np.sqrt(megapixels * 1e6 * 3 / 4))
    disparity = round(0.02 * width)
    focal = disparity * _DEPTH_M / _SPACING_M
    calibration = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    rng = np.random.default_rng(0)
    texture = rng.integers(0, 256, (height, width + num_sources * disparity), dtype=np.uint8)
    texture = cv2.GaussianBlur(texture, (0, 0), 2.0)
    cv2.normalize(texture, texture, 0, 255, cv2.NORM_MINMAX)
    (folder / "images").mkdir(parents=True)
    views = []
    for number in range(num_sources + 1):
        pose = np.concatenate([np.eye(3), [[-_SPACING_M * number], [0], [0]]], axis=1)
        name = f"{number}.png"
        views.append(MvsView(name=name, width=width, height=height, calibration=calibration, cam_from_world=pose))
        cv2.imwrite(str(folder / "images" / name), texture[:, number * disparity :][:, :width])
    return MvsJob(
        workspace=folder,
        views=tuple(views),
        # Only the first is searched.
        sources=(tuple(range(1, num_sources + 1)), *[()] * num_sources),
        boxes_in_world=np.array([[[-100.0, -100, 5], [100, 100, 20]]]),
        points_in_world=np.zeros((0, 3)),
        point_views=(np.zeros(0, np.int64),) * len(views),
    )


if __name__ == "__main__":
    main()
