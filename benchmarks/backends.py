"""Time and quality of the dense back-ends that can run here, side by side on a rendered street.

    python -m benchmarks.backends TRUTH MODEL WORK --backends openmvs,patchmatch --openmvs-path BIN --threads 1

TRUTH is a folder as `sample_data.render_street` writes it (`images`, `gt.ply`, `gt_mesh.ply`), MODEL a COLMAP model of
it in the same world, WORK a folder to work in, emptied first. All images are one cluster, at their true poses. Without
`--backends`, all that `cityrecon doctor` calls available. The maps of all are fused by our fusion, once per number of
`--views-agree`; for OpenMVS a further row scores the cloud that it fuses itself, neither masked nor cut to the region.

Time is CPU-seconds, user and system, of the program and its children, with our kernels compiled before: of the maps,
per megapixel, and of fusing them. What a GPU does shows in the wall time of the maps only. Scores are accuracy /
completeness / F in %, both sides thinned to 5 cm voxels, accuracy to the mesh. Without `gt.ply` only points count.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import logging
import resource
import shutil
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from benchmarks.dense_workspace import make_workspace
from benchmarks.machine import describe_machine
from fusion.cloud import PointCloud, read_ply, write_ply
from fusion.compare import CompareOptions, compare_clouds
from fusion.depth_fusion import FusionOptions, fuse_depth_maps
from mvs_backends import backend_names, get_backend
from mvs_backends.base import MvsJob, MvsOptions, Preset
from mvs_backends.process import find_program

_THRESHOLDS_M = (0.02, 0.05, 0.1, 0.2)
_EVERYWHERE = np.array([[-1e9] * 3, [1e9] * 3])
_DENSIFY_AND_FUSE = """#!{python}
import json, resource, shutil, subprocess, sys
subprocess.run([{program!r}, *sys.argv[1:]], check=True)
given = dict(zip(sys.argv[1::2], sys.argv[2::2]))
given |= {{"--geometric-iters": "0", "--postprocess-dmaps": "0", "--fusion-mode": "0", "--archive-type": "1"}}
before = resource.getrusage(resource.RUSAGE_CHILDREN)
subprocess.run([{program!r}, *(part for pair in given.items() for part in pair)], check=True)
after = resource.getrusage(resource.RUSAGE_CHILDREN)
shutil.move(given["-w"] + "/dense.ply", {keep!r} + "/own.ply")
seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
open({keep!r} + "/own.json", "w").write(json.dumps(seconds))
"""
"""Stands before DensifyPointCloud: estimates maps as it was told to, then fuses them as OpenMVS does."""


def main() -> None:
    """Print one row per back-end."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("truth", type=Path)
    parser.add_argument("model", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--backends", default="", help="comma-separated")
    parser.add_argument("--frames", default="0-9999", help="first-last, by file name")
    parser.add_argument("--max-image-size", type=int, default=0)
    parser.add_argument("--preset", type=Preset, default=Preset.NORMAL)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--views-agree", type=int, nargs="+", default=[2, 3], help="FusionOptions.min_num_pixels")
    for program in ("openmvs", "colmap", "acmp"):
        parser.add_argument(f"--{program}-path", default="")
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.WARNING)
    options = MvsOptions(
        preset=arguments.preset,
        openmvs_path=arguments.openmvs_path,
        colmap_path=arguments.colmap_path,
        acmp_path=arguments.acmp_path,
    )
    names = [name for name in arguments.backends.split(",") if name]
    names = names or [name for name in backend_names() if get_backend(name).availability(options).ok]
    print(describe_machine(), end="\n\n")
    print(
        "| back-end | wall s | CPU-s | per MP | fusion CPU-s | points | "
        + _cells(f"{100 * t:g} cm" for t in _THRESHOLDS_M)
    )
    print("|---" * (6 + len(_THRESHOLDS_M)) + "|")
    first, last = (int(part) for part in arguments.frames.split("-"))
    for name in names:
        work = arguments.work / name
        shutil.rmtree(work, ignore_errors=True)
        job = make_workspace(
            work,
            model=arguments.model,
            images=arguments.truth / "images",
            frames=range(first, last + 1),
            max_image_size_px=arguments.max_image_size,
        )
        times = _estimate(name, job, options, work, arguments.threads)
        _score(name, job, work, arguments.truth, arguments.views_agree, times)


def _estimate(name: str, job: MvsJob, options: MvsOptions, work: Path, num_threads: int) -> tuple[float, float]:
    """Leave the maps; wall time and CPU-seconds that they took."""
    if name == "patchmatch":
        _compile(job)
    if name == "openmvs":
        options = dataclasses.replace(options, openmvs_path=str(_fusing_openmvs(work / "bin", options.openmvs_path)))
    wall_started, started = time.perf_counter(), _cpu_seconds()
    get_backend(name).estimate(job=job, options=options, num_threads=num_threads)
    wall_s, cpu_s = time.perf_counter() - wall_started, _cpu_seconds() - started
    own = work / "bin" / "own.json"
    own_s = float(json.loads(own.read_text())) if own.exists() else 0.0
    return wall_s - own_s, cpu_s - own_s


def _score(
    name: str, job: MvsJob, work: Path, truth: Path, views_agree: Sequence[int], times: tuple[float, float]
) -> None:
    wall_s, cpu_s = times
    megapixels = sum(view.width * view.height for view in job.views) / 1e6
    maps = f"{wall_s:,.0f}", f"{cpu_s:,.0f}", f"{cpu_s / megapixels:.1f}"
    for count in views_agree:
        started = _cpu_seconds()
        fusion = FusionOptions(min_num_pixels=count)
        cloud = fuse_depth_maps(job.workspace, work / "scratch.ply", options=fusion, bounds=_EVERYWHERE)
        fusion_s = _cpu_seconds() - started
        write_ply(work / f"cloud{count}.ply", cloud)
        _print_row([f"{name}, {count} views agree", *maps, f"{fusion_s:.0f}"], cloud, truth)
    own = work / "bin" / "own.json"
    if own.exists():
        seconds = float(json.loads(own.read_text()))
        _print_row([f"{name}, its own fusion", *maps, f"{seconds:.0f}"], read_ply(own.with_suffix(".ply")), truth)


def _print_row(label_and_times: Sequence[str], cloud: PointCloud, truth: Path) -> None:
    scores: Sequence[str] = ["" for _ in _THRESHOLDS_M]
    if len(cloud) and (truth / "gt.ply").exists():
        found = compare_clouds(
            cloud,
            read_ply(truth / "gt.ply"),
            mesh=truth / "gt_mesh.ply",
            options=CompareOptions(thresholds_m=_THRESHOLDS_M),
        )
        scores = [f"{100 * s.accuracy:.1f} / {100 * s.completeness:.1f} / {100 * s.f_score:.1f}" for s in found.scores]
    print("| " + _cells([*label_and_times, f"{len(cloud):,}", *scores]), flush=True)


def _cells(values: Iterable[str]) -> str:
    return " | ".join(values) + " |"


def _fusing_openmvs(folder: Path, given: str) -> Path:
    """A folder with OpenMVS's programs whose DensifyPointCloud also fuses, into `own.ply` and `own.json`."""
    folder.mkdir()
    for name in ("InterfaceCOLMAP", "DensifyPointCloud"):
        program = find_program(name, given)
        if program is None:
            raise SystemExit(f"no {name}; set --openmvs-path")
        if name == "InterfaceCOLMAP":
            (folder / name).symlink_to(program)
            continue
        text = _DENSIFY_AND_FUSE.format(python=sys.executable, program=str(program), keep=str(folder))
        (folder / name).write_text(text, encoding="utf-8")
        (folder / name).chmod(0o755)
    return folder


def _compile(job: MvsJob) -> None:
    """Estimate two views, so that no kernel is compiled while the time is taken."""
    pair = dataclasses.replace(job, views=job.views[:2], sources=((1,), (0,)), point_views=job.point_views[:2])
    get_backend("patchmatch").estimate(job=pair, options=MvsOptions(preset=Preset.PREVIEW), num_threads=1)
    for view in range(2):
        pair.depth_map_path(view).unlink()
        pair.normal_map_path(view).unlink()


def _cpu_seconds() -> float:
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


if __name__ == "__main__":
    main()
