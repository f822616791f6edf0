"""COLMAP's PatchMatch stereo (Schoenberger et al. 2016) on CUDA: by pycolmap built with CUDA, or by the executable."""

from __future__ import annotations

import functools
import math
import os
import sys
import tempfile
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap

from mvs_backends.base import Availability, MvsBackend, MvsError, MvsJob, MvsOptions, Preset, Progress
from mvs_backends.colmap_maps import has_maps, read_map, write_empty_maps, write_wanted_maps
from mvs_backends.depth_range import usable_views, view_depth_range
from mvs_backends.hardware import chosen_gpus, gpu_environment, installed_gpus, memory_budget_gib
from mvs_backends.process import find_program, run_subprocess
from mvs_backends.trial import Trial, is_right, trial_job, try_once

_NUM_SOURCES = {Preset.PREVIEW: 5, Preset.NORMAL: 10, Preset.HIGH: 20}
_NUM_ITERATIONS = {Preset.PREVIEW: 3, Preset.NORMAL: 5, Preset.HIGH: 5}
_TRIAL_TIMEOUT_S = 120.0


class Colmap(MvsBackend):
    """PatchMatch stereo with a photometric and a geometric pass; the GPUs it sees share the views of a cluster."""

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
        trial = _try_out(command, options.gpu_index)
        how = f"failed: {trial.problem}" if trial.problem else "succeeded"
        name = command[0] if len(command) == 1 else f"pycolmap {pycolmap.__version__}"
        return Availability(ok=trial.problem is None, reason=f"a trial job with {name} at {trial.time} {how}")

    def estimate(self, *, job: MvsJob, options: MvsOptions, num_threads: int, progress: Progress | None = None) -> None:
        """See `MvsBackend.estimate`."""
        command = _command(options)
        if command is None:
            raise MvsError(self.availability(options).reason)
        _estimate(job, options, command, num_threads=num_threads, progress=progress)


def _command(options: MvsOptions) -> tuple[str, ...] | None:
    """How `colmap` is called here: by the executable that was named, else by pycolmap with CUDA, else from PATH."""
    if not options.colmap_path and pycolmap.has_cuda:
        return sys.executable, "-m", "mvs_backends.colmap_command"
    found = find_program("colmap", options.colmap_path)
    return None if found is None else (str(found),)


def _estimate(
    job: MvsJob, options: MvsOptions, command: tuple[str, ...], *, num_threads: int, progress: Progress | None
) -> None:
    stereo = job.workspace / "stereo"
    num_sources = options.num_source_views or _NUM_SOURCES[options.preset]
    usable = usable_views(job)
    groups = _groups(job, list(usable))
    for view in range(len(job.views)):
        if view not in usable:
            write_empty_maps(job, view)
        else:
            _remove_broken_maps(job, view)

    def count() -> None:
        if progress is not None:
            progress(sum(has_maps(job, view) for view in range(len(job.views))), len(job.views))

    log_file = stereo / "colmap.log"
    environment = gpu_environment(chosen_gpus(options.gpu_index) if options.gpu_index != "-1" else ())
    cache_gib = options.cache_gib or memory_budget_gib(num_threads)
    # A geometric pass compares a view with the photometric maps of its sources, so all groups have these first.
    for is_geometric in (False, True):
        for index, ((near, far), views) in enumerate(groups):
            config = stereo / f"patch-match-{index}.cfg"
            config.write_text(
                "".join(_problem(job, view, usable[view][:num_sources]) for view in views), encoding="utf-8"
            )
            arguments = {
                "workspace_path": job.workspace,
                "config_path": config,
                "PatchMatchStereo.depth_min": f"{near:.9g}",
                "PatchMatchStereo.depth_max": f"{far:.9g}",
                "PatchMatchStereo.geom_consistency": int(is_geometric),
                "PatchMatchStereo.filter": int(is_geometric),
                "PatchMatchStereo.num_iterations": _NUM_ITERATIONS[options.preset],
                "PatchMatchStereo.gpu_index": -1,
                "PatchMatchStereo.cache_size": f"{cache_gib:.3g}",
            }
            run_subprocess(
                [*command, "patch_match_stereo", *(str(part) for k, v in arguments.items() for part in (f"--{k}", v))],
                log_file=log_file,
                environment=environment,
                timeout_s=options.program_timeout_s,
                on_wait=count,
            )
    for view in usable:
        try:
            depth, normal = read_map(job.depth_map_path(view)), read_map(job.normal_map_path(view))
        except (OSError, ValueError) as error:
            raise MvsError(f"COLMAP left no whole maps of {job.views[view].name}; see {log_file}") from error
        write_wanted_maps(job, view, depth, normal)
    count()


def _groups(job: MvsJob, views: Sequence[int]) -> list[tuple[tuple[float, float], list[int]]]:
    """Views by depth range to a factor of two: COLMAP takes one range per call."""
    ranges = {view: found for view in views if (found := view_depth_range(job, view)) is not None}
    groups: dict[tuple[int, int], list[int]] = defaultdict(list)
    for view, found in ranges.items():
        groups[math.floor(math.log2(found[0])), math.ceil(math.log2(found[1]))].append(view)
    result = []
    for _, group in sorted(groups.items()):
        bounds = np.array([ranges[view] for view in group])
        result.append(((float(bounds[:, 0].min()), float(bounds[:, 1].max())), group))
    return result


def _problem(job: MvsJob, view: int, sources: Sequence[int]) -> str:
    """Two lines of COLMAP's `patch-match.cfg`."""
    names = [job.views[index].name for index in (view, *sources)]
    for name in names:
        if "," in name:
            raise MvsError(f"image {name!r} has a comma in its name, which separates names for COLMAP; rename it")
    return f"{names[0]}\n{', '.join(names[1:])}\n"


def _remove_broken_maps(job: MvsJob, view: int) -> None:
    """COLMAP skips what is there; a map cut short by a kill or a full disk must not count."""
    size = job.views[view].height, job.views[view].width
    for geometric in (job.depth_map_path(view), job.normal_map_path(view)):
        for path in (geometric, geometric.with_name(geometric.name.replace(".geometric.", ".photometric."))):
            try:
                is_whole = read_map(path).shape[:2] == size
            except (OSError, ValueError):
                is_whole = False
            if not is_whole:
                path.unlink(missing_ok=True)


@functools.cache
def _try_out(command: tuple[str, ...], gpu_index: str) -> Trial:
    """Estimate the depth of a textured plane, or remember how that went."""
    gpus = "; ".join(installed_gpus()) or "unknown"
    shown = os.environ.get("CUDA_VISIBLE_DEVICES", "all")
    subject = f"{_version(command)}; index {gpu_index} of {shown} of the GPUs {gpus}"
    return try_once(subject, lambda: _problem_of_trial(command, gpu_index))


def _version(command: tuple[str, ...]) -> str:
    if len(command) > 1:
        return f"pycolmap {pycolmap.__version__}"
    found = Path(command[0]).stat()
    return f"{command[0]} of {found.st_size} bytes, {found.st_mtime_ns}"


def _problem_of_trial(command: tuple[str, ...], gpu_index: str) -> str | None:
    with tempfile.TemporaryDirectory() as scratch:
        job, depth = trial_job(Path(scratch))
        options = MvsOptions(gpu_index=gpu_index, program_timeout_s=_TRIAL_TIMEOUT_S)
        try:
            _estimate(job, options, command, num_threads=1, progress=None)
        except MvsError as error:
            return str(error).partition(" (all in ")[0]
        return None if is_right(job, depth) else "it found wrong depths"
