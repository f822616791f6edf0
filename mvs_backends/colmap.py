"""COLMAP's PatchMatch stereo (Schoenberger et al. 2016) on CUDA: by pycolmap built with CUDA, or by the executable."""

from __future__ import annotations

import functools
import math
import sys
import tempfile
from collections import defaultdict
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from mvs_backends.base import Availability, MvsBackend, MvsError, MvsJob, MvsOptions, MvsView, Preset, Progress
from mvs_backends.colmap_maps import has_maps, read_map, write_empty_maps, write_wanted_maps
from mvs_backends.depth_range import view_depth_range
from mvs_backends.process import find_program, run_subprocess

_NUM_SOURCES = {Preset.PREVIEW: 5, Preset.NORMAL: 10, Preset.HIGH: 20}
_NUM_ITERATIONS = {Preset.PREVIEW: 3, Preset.NORMAL: 5, Preset.HIGH: 5}
_TRIAL_TIMEOUT_S = 120.0
_MAX_TRIAL_ERROR = 0.02
_MIN_TRIAL_SHARE = 0.25
"""The images' borders and what is seen by one neighbour only may stay empty."""


class Colmap(MvsBackend):
    """PatchMatch stereo with a photometric and a geometric pass, several GPUs sharing the views of a cluster."""

    uses_gpu = True

    def availability(self, options: MvsOptions) -> Availability:
        """Whether a tiny job succeeds: that a program was built with CUDA doesn't say that there is a GPU."""
        command = _command(options)
        if command is None:
            return Availability(
                ok=False,
                reason="pycolmap has no CUDA and no executable colmap was found; install pycolmap-cuda12 instead of "
                "pycolmap, or set --colmap-path",
            )
        problem = _try_out(command)
        return Availability(ok=problem is None, reason=problem or f"a trial job succeeded with {' '.join(command)}")

    def estimate(self, *, job: MvsJob, options: MvsOptions, num_threads: int, progress: Progress | None = None) -> None:
        """See `MvsBackend.estimate`."""
        command = _command(options)
        if command is None:
            raise MvsError(self.availability(options).reason)
        _estimate(job, options, command, progress)


def _command(options: MvsOptions) -> tuple[str, ...] | None:
    """How `colmap` is called here: by the executable that was named, else by pycolmap with CUDA, else from PATH."""
    if not options.colmap_path and pycolmap.has_cuda:
        return sys.executable, "-m", "mvs_backends.colmap_command"
    found = find_program("colmap", options.colmap_path)
    return None if found is None else (str(found),)


def _estimate(job: MvsJob, options: MvsOptions, command: tuple[str, ...], progress: Progress | None) -> None:
    stereo = job.workspace / "stereo"
    num_sources = options.num_source_views or _NUM_SOURCES[options.preset]
    groups = _groups(job)
    used = [view for _, views in groups for view in views]
    for view in range(len(job.views)):
        if view not in used:
            write_empty_maps(job, view)
        else:
            _remove_broken_maps(job, view)

    def count() -> None:
        if progress is not None:
            progress(sum(has_maps(job, view) for view in range(len(job.views))), len(job.views))

    # A geometric pass compares a view with the photometric maps of its sources, so all groups have these first.
    for is_geometric in (False, True):
        for index, ((near, far), views) in enumerate(groups):
            config = stereo / f"patch-match-{index}.cfg"
            config.write_text("".join(_problem(job, view, num_sources) for view in views), encoding="utf-8")
            arguments = {
                "workspace_path": job.workspace,
                "config_path": config,
                "PatchMatchStereo.depth_min": f"{near:.9g}",
                "PatchMatchStereo.depth_max": f"{far:.9g}",
                "PatchMatchStereo.geom_consistency": int(is_geometric),
                "PatchMatchStereo.filter": int(is_geometric),
                "PatchMatchStereo.num_iterations": _NUM_ITERATIONS[options.preset],
                "PatchMatchStereo.gpu_index": options.gpu_index,
                "PatchMatchStereo.cache_size": f"{options.cache_gib:g}",
            }
            run_subprocess(
                [*command, "patch_match_stereo", *(str(part) for k, v in arguments.items() for part in (f"--{k}", v))],
                log_file=stereo / "colmap.log",
                timeout_s=options.program_timeout_s,
                on_wait=count,
            )
    for view in used:
        if not has_maps(job, view):
            raise MvsError(f"COLMAP left no maps of {job.views[view].name}; see {stereo / 'colmap.log'}")
        write_wanted_maps(job, view, read_map(job.depth_map_path(view)), read_map(job.normal_map_path(view)))
    count()


def _groups(job: MvsJob) -> list[tuple[tuple[float, float], list[int]]]:
    """Views with sources, by depth range to a factor of two: COLMAP takes one range per call."""
    ranges = [view_depth_range(job, view) for view in range(len(job.views))]
    groups: dict[tuple[int, int], list[int]] = defaultdict(list)
    for view, found in enumerate(ranges):
        if found is not None and job.sources[view]:
            groups[math.floor(math.log2(found[0])), math.ceil(math.log2(found[1]))].append(view)
    result = []
    for _, views in sorted(groups.items()):
        bounds = np.array([ranges[view] for view in views])
        result.append(((float(bounds[:, 0].min()), float(bounds[:, 1].max())), views))
    return result


def _problem(job: MvsJob, view: int, num_sources: int) -> str:
    """Two lines of COLMAP's `patch-match.cfg`."""
    names = [job.views[index].name for index in (view, *job.sources[view][:num_sources])]
    for name in names:
        if "," in name:
            raise MvsError(f"image {name!r} has a comma in its name, which separates names for COLMAP; rename it")
    return f"{names[0]}\n{', '.join(names[1:])}\n"


def _remove_broken_maps(job: MvsJob, view: int) -> None:
    """COLMAP skips what is there; a map cut short by a kill must not count."""
    for geometric in (job.depth_map_path(view), job.normal_map_path(view)):
        for path in (geometric, geometric.with_name(geometric.name.replace(".geometric.", ".photometric."))):
            try:
                read_map(path)
            except (OSError, ValueError):
                path.unlink(missing_ok=True)


@functools.cache
def _try_out(command: tuple[str, ...]) -> str | None:
    """Estimate the depth of a textured plane.

    Returns:
        Why that failed; None if it worked.
    """
    with tempfile.TemporaryDirectory() as scratch:
        job, depth = _trial_job(Path(scratch))
        try:
            _estimate(job, MvsOptions(program_timeout_s=_TRIAL_TIMEOUT_S), command, None)
        except MvsError as error:
            return f"a trial job with {command[0]} failed: {error}".partition(" (all in ")[0]
        found = read_map(job.depth_map_path(1))
    right = np.abs(found / depth - 1) <= _MAX_TRIAL_ERROR
    return None if right.mean() >= _MIN_TRIAL_SHARE else f"a trial job with {command[0]} found wrong depths"


def _trial_job(folder: Path) -> tuple[MvsJob, float]:
    """Three views side by side of a plane parallel to the images, each 8 pixels on, and its depth."""
    width, height, focal_px, step_px, depth = 160, 120, 150.0, 8, 10.0
    texture = cv2.GaussianBlur(
        np.random.default_rng(0).integers(0, 256, (height, width + 64)).astype(np.float32), (5, 5), 1
    )
    calibration = np.array([[focal_px, 0, width / 2], [0, focal_px, height / 2], [0, 0, 1.0]])
    for name in ("images", "sparse", "stereo/depth_maps", "stereo/normal_maps"):
        (folder / name).mkdir(parents=True)
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(
            camera_id=1, model="PINHOLE", width=width, height=height, params=[focal_px, focal_px, width / 2, height / 2]
        )
    )
    views = []
    for index in range(3):
        pose = np.column_stack([np.eye(3), [-index * step_px * depth / focal_px, 0.0, 0.0]])
        views.append(
            MvsView(name=f"{index}.png", width=width, height=height, calibration=calibration, cam_from_world=pose)
        )
        image = pycolmap.Image(name=f"{index}.png", camera_id=1, image_id=index + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
        pixels = texture[:, index * step_px : index * step_px + width]
        cv2.imwrite(str(folder / "images" / f"{index}.png"), pixels)
    model.write_binary(folder / "sparse")
    none = np.zeros(0, np.int64)
    job = MvsJob(
        workspace=folder,
        views=tuple(views),
        sources=((1, 2), (0, 2), (0, 1)),
        boxes_in_world=np.array([[[-50.0, -50.0, 0.5 * depth], [50.0, 50.0, 2.0 * depth]]]),
        points_in_world=np.zeros((0, 3)),
        point_views=(none, none, none),
    )
    return job, depth
