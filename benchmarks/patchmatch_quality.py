"""Time and quality of the embedded stereo back-end on a rendered street, by ingredient.

    python -m sample_data.render_street TRUTH --seed 11 --path straight --frames 6 --richness 0.1 \\
        --width 480 --height 300
    cityrecon capture TRUTH/images RUN --rig TRUTH/rig.json
    cityrecon sfm RUN --poses TRUTH/poses_gt.txt
    python -m benchmarks.patchmatch_quality TRUTH RUN/sfm/model WORK --set planar_prior=False

TRUTH is a folder as `sample_data.render_street` writes it (`images`, `gt.ply`, `gt_mesh.ply`), MODEL a COLMAP model of
it in the same world, WORK a folder to work in. Each `--set` is one run with the preset's `PatchMatchOptions` but for
the fields named (`a=1;b=2`); the preset itself runs first. `region=20` is special: side of the square in metres around
the cameras that is reconstructed. With `--score-within 20` only what lies in such a square is scored. Time is
CPU-seconds, user and system, of the depth maps alone, with the kernels compiled before.

Scores are accuracy/completeness/F in % after thinning to 5 cm voxels: first over everything, then over surfaces with
little texture alone: samples of `gt.ply` around which grey values deviate by less than 3 in the images that see them,
and the points of the cloud whose nearest sample is one of those. Normals: of the points within 5 cm of the mesh, those
whose normal is within 10 degrees of its, and the mean angle.
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import logging
import resource
import shutil
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.dense_workspace import make_workspace
from benchmarks.machine import describe_machine
from benchmarks.surface_texture import nearest, normal_errors, texture_of_samples
from fusion.cloud import PointCloud, read_ply
from fusion.compare import cloud_distances, mesh_distances
from fusion.depth_fusion import FusionOptions, fuse_depth_maps
from fusion.thinning import thin
from mvs_backends.base import MvsJob, Preset
from mvs_backends.patchmatch.backend import estimate_maps
from mvs_backends.patchmatch.geometry import level_camera
from mvs_backends.patchmatch.options import PRESETS, PatchMatchOptions

_THRESHOLDS_M = (0.02, 0.05, 0.1, 0.2)
_VOXEL_M = 0.05
_LITTLE_TEXTURE = 3.0
_RIGHT_NORMAL_DEG = 10.0


def main() -> None:
    """Print one row per setting."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("truth", type=Path)
    parser.add_argument("model", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--frames", default="0-9999", help="first-last, by file name")
    parser.add_argument("--max-image-size", type=int, default=0)
    parser.add_argument("--score-within", type=float, default=0.0, help="side of a square in metres; 0: everywhere")
    parser.add_argument("--preset", type=Preset, default=Preset.NORMAL)
    parser.add_argument("--set", action="append", default=[], dest="settings")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--min-num-pixels", type=int, default=FusionOptions().min_num_pixels)
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.WARNING)
    print(describe_machine(), end="\n\n")
    first, last = (int(part) for part in arguments.frames.split("-"))
    heads = [f"{where}, {round(100 * t)} cm" for where in ("all", "little texture") for t in _THRESHOLDS_M]
    print(f"| setting | CPU-s/MP | points | {' | '.join(heads)} | normals |")
    print("|---|---|---|" + "---|" * (len(heads) + 1))
    samples = thin(read_ply(arguments.truth / "gt.ply"), _VOXEL_M).points
    scored = np.array([[-1e9] * 3, [1e9] * 3])
    is_plain = np.zeros(0, np.bool_)
    for number, setting in enumerate(["", *arguments.settings]):
        changes = {key: ast.literal_eval(value) for key, value in _pairs(setting)}
        side_m = float(changes.pop("region", 0.0))
        options = dataclasses.replace(PRESETS[arguments.preset], **changes)
        job = make_workspace(
            arguments.work,
            model=arguments.model,
            images=arguments.truth / "images",
            frames=range(first, last + 1),
            side_m=side_m,
            max_image_size_px=arguments.max_image_size,
        )
        if number == 0:
            _compile(job, options)
            if arguments.score_within:
                centers = np.array([level_camera(view, 0).center_in_world for view in job.views])
                half = arguments.score_within / 2
                scored[:, :2] = centers.mean(axis=0)[:2] + [[-half], [half]]
                samples = samples[np.all((samples >= scored[0]) & (samples <= scored[1]), axis=1)]
            is_plain = texture_of_samples(job, samples, arguments.truth / "gt_mesh.ply") < _LITTLE_TEXTURE
        shutil.rmtree(job.workspace / "stereo" / "depth_maps")
        (job.workspace / "stereo" / "depth_maps").mkdir()
        started = _cpu_seconds()
        estimate_maps(job=job, options=options, seed=0, num_threads=arguments.threads)
        cost = (_cpu_seconds() - started) / (sum(v.width * v.height for v in job.views) / 1e6)
        fusion = FusionOptions(min_num_pixels=arguments.min_num_pixels)
        cloud = fuse_depth_maps(job.workspace, job.workspace / "fused.ply", options=fusion, bounds=scored)
        found = _scores(cloud, samples, is_plain, arguments.truth / "gt_mesh.ply")
        cells = ["/".join(f"{100 * part:.1f}" for part in score) for score in found]
        angles = normal_errors(cloud, arguments.truth / "gt_mesh.ply", _VOXEL_M)
        cells.append(f"{np.mean(angles < _RIGHT_NORMAL_DEG):.1%}, {np.mean(angles):.1f}°")
        print(f"| {setting or 'preset'} | {cost:.1f} | {len(cloud):,} | {' | '.join(cells)} |", flush=True)


def _scores(
    cloud: PointCloud, samples: NDArray[np.float32], is_plain: NDArray[np.bool_], mesh: Path
) -> list[tuple[float, float, float]]:
    """Accuracy, completeness and F at all thresholds, over everything and then where there is little texture."""
    points = thin(cloud, _VOXEL_M).points
    errors, gaps = mesh_distances(points, mesh), cloud_distances(samples, points)
    scores = []
    for of_points, of_samples in ((slice(None), slice(None)), (is_plain[nearest(points, samples)], is_plain)):
        for threshold in _THRESHOLDS_M:
            accuracy = float(np.mean(errors[of_points] < threshold))
            completeness = float(np.mean(gaps[of_samples] < threshold))
            scores.append((accuracy, completeness, 2 * accuracy * completeness / max(accuracy + completeness, 1e-9)))
    return scores


def _pairs(setting: str) -> list[tuple[str, str]]:
    # Tuples hold commas themselves, so fields are separated by ';'.
    return [(key, value) for key, _, value in (part.partition("=") for part in setting.split(";") if part)]


def _compile(job: MvsJob, options: PatchMatchOptions) -> None:
    pair = dataclasses.replace(job, views=job.views[:2], sources=((1,), (0,)), point_views=job.point_views[:2])
    quick = dataclasses.replace(options, iterations=(1, 1), num_random=1)
    estimate_maps(job=pair, options=quick, seed=0, num_threads=1)


def _cpu_seconds() -> float:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


if __name__ == "__main__":
    main()
