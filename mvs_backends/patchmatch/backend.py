"""The embedded CPU back-end: schedule of passes over the views of a cluster, kept work, and the maps at the end."""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
import tempfile
import time
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mvs_backends.base import Availability, MvsBackend, MvsJob, MvsOptions, Progress
from mvs_backends.colmap_maps import has_maps, write_maps
from mvs_backends.masks import read_mask
from mvs_backends.patchmatch.averaging import averaged_planes
from mvs_backends.patchmatch.cost.kernels import PADDING, Reference
from mvs_backends.patchmatch.geometry import LevelCamera, depth_and_normal, level_camera
from mvs_backends.patchmatch.images import ImageCache
from mvs_backends.patchmatch.kernels import sweep_rows
from mvs_backends.patchmatch.options import PatchMatchOptions, options_of_preset
from mvs_backends.patchmatch.prior import interpolated_planes
from mvs_backends.patchmatch.search import (
    Hypotheses,
    LevelSearch,
    gather_sources,
    inverse_range,
    sparse_points_in_image,
    upsampled,
    window,
)
from mvs_backends.patchmatch.tiny_job import tiny_job

logger = logging.getLogger(__name__)


class PatchMatch(MvsBackend):
    """PatchMatch stereo on the CPU after ACMP (Xu & Tao 2020) and ACMM (2019), bounded by the cluster's region."""

    def availability(self, options: MvsOptions) -> Availability:
        """Always: it needs nothing but this package."""
        return Availability(ok=True, reason="built in, runs on the CPU")

    def prepare(self) -> None:
        """Compile the kernels, unless this machine has kept them."""
        kept = Path(sweep_rows.stats.cache_path)
        if any(kept.glob("kernels.sweep_rows-*.nbi")):
            return
        logger.info("compiling the stereo kernels for this machine, once (less than a minute)")
        logger.debug("compiled kernels are kept in %s", kept)
        with tempfile.TemporaryDirectory() as folder:
            options = options_of_preset(MvsOptions())
            estimate_maps(job=tiny_job(Path(folder)), options=options, seed=0, num_threads=1)

    def estimate(self, *, job: MvsJob, options: MvsOptions, num_threads: int, progress: Progress | None = None) -> None:
        """See `MvsBackend.estimate`."""
        estimate_maps(
            job=job,
            options=options_of_preset(options),
            seed=options.seed,
            num_threads=num_threads,
            progress=progress,
        )


def estimate_maps(
    *, job: MvsJob, options: PatchMatchOptions, seed: int, num_threads: int, progress: Progress | None = None
) -> None:
    """Depth and normal maps of all reference views of a job.

    Every pass runs over all views before the next one begins, since a geometric pass compares a view with its source
    views' maps of the pass before; at the end each map is averaged with all others. What a pass found for a view is
    kept in `stereo/patchmatch/` until all is done.

    Raises:
        MvsError: an image or mask can't be read.
    """
    if all(has_maps(job, view) for view in range(len(job.views))):
        return
    num_levels = len(options.iterations)
    total = (num_levels + 1) * len(job.views)
    folder = _kept_folder(job, options, seed)
    with ThreadPoolExecutor(num_threads) as executor:
        images = ImageCache(job)
        for number in range(num_levels + 1):
            for view in range(len(job.views)):
                last = number == num_levels
                done = has_maps(job, view) if last else _kept_file(folder, number, view).exists()
                if not done:
                    started = time.perf_counter()
                    if last:
                        _write_averaged(job, view, options, images, folder, executor)
                    else:
                        found = _search_view(job, view, number, options, seed, images, folder, executor)
                        _save(_kept_file(folder, number, view), found)
                    logger.debug(
                        "%s: pass %d of %d in %.1f s",
                        job.views[view].name,
                        number + 1,
                        num_levels + 1,
                        time.perf_counter() - started,
                    )
                if progress is not None:
                    progress((number * len(job.views) + view + 1) * len(job.views) // total, len(job.views))
    shutil.rmtree(folder)


def _search_view(
    job: MvsJob,
    view: int,
    number: int,
    options: PatchMatchOptions,
    seed: int,
    images: ImageCache,
    folder: Path,
    executor: Executor,
) -> Hypotheses:
    """Pass `number` for one view."""
    level = _level(options, number)
    camera = level_camera(job.views[view], level)
    grey, _ = images.get(view, level)
    limits = inverse_range(job, view, camera, read_mask(job, view, camera.width, camera.height))
    reference = _reference(camera, grey, limits)
    # By index: nothing depends on the order in which a job names them.
    sources = sorted(job.sources[view][: options.num_source_views])
    if not sources or not (limits[..., 1] > 0).any():
        shape = grey.shape
        return Hypotheses(
            plane=np.zeros((*shape, 3), np.float32),
            cost=np.full(shape, 2, np.float32),
            view=np.full(shape, -1, np.int8),
        )
    geometric = number > 0 and (options.geometric_weight > 0 or options.planar_prior)

    def previous(source: int) -> tuple[NDArray[np.float32], int]:
        return _load(_kept_file(folder, number - 1, source)).plane, _level(options, number - 1)

    search = LevelSearch(
        reference=reference,
        sources=gather_sources(job, view, sources, level, images, previous if geometric else None),
        window=window(options),
        options=options,
        seed=seed + 1000003 * view + 7919 * number,
        executor=executor,
    )
    if number == 0:
        points, inverse_depths = sparse_points_in_image(job, view, camera)
        start = search.start(interpolated_planes(points, inverse_depths, camera.width, camera.height))
    else:
        coarse = _load(_kept_file(folder, number - 1, view))
        start = upsampled(coarse, images.get(view, _level(options, number - 1))[0], reference)
    if number > 0 and options.planar_prior:
        start = search.with_planes(start)
    found = search.sweep(start, options.iterations[number], random_depth=number == 0)
    if number == len(options.iterations) - 1:
        if number > 0 and options.planar_prior:
            found = search.with_planes(found)
        if options.smoothing_radius_px > 0:
            found = search.smoothed(found, options.smoothing_radius_px)
        found.plane[~(found.cost <= options.max_cost)] = 0.0
    return found


def _full_size(job: MvsJob, view: int, found: Hypotheses, options: PatchMatchOptions, images: ImageCache) -> Hypotheses:
    """The last pass' hypotheses at the size of the image."""
    if options.finest_level == 0:
        return found
    camera = level_camera(job.views[view], 0)
    limits = inverse_range(job, view, camera, read_mask(job, view, camera.width, camera.height))
    reference = _reference(camera, images.get(view, 0)[0], limits)
    return upsampled(found, images.get(view, options.finest_level)[0], reference)


def _reference(camera: LevelCamera, grey: NDArray[np.uint8], limits: NDArray[np.float32]) -> Reference:
    calibration = camera.calibration
    return Reference(
        padded_grey=np.pad(grey, PADDING, mode="edge"),
        inverse_range=limits,
        intrinsics=np.array([calibration[0, 0], calibration[1, 1], calibration[0, 2], calibration[1, 2]], np.float32),
    )


def _level(options: PatchMatchOptions, number: int) -> int:
    return options.finest_level + len(options.iterations) - 1 - number


def _write_averaged(
    job: MvsJob, view: int, options: PatchMatchOptions, images: ImageCache, folder: Path, executor: Executor
) -> None:
    """Leave the maps of a view, averaged with those of the other views, as COLMAP's."""
    last, level = len(options.iterations) - 1, options.finest_level
    found = _load(_kept_file(folder, last, view))
    if options.average_views:
        camera = level_camera(job.views[view], level)
        others = [
            (level_camera(job.views[other], level), partial(_load_plane, _kept_file(folder, last, other)))
            for other in sorted(job.sources[view])
        ]
        plane = averaged_planes(found.plane, camera, others, executor)
        limits = inverse_range(job, view, camera, read_mask(job, view, camera.width, camera.height))
        known = plane[..., 0] > 0
        plane[known, 0] = np.clip(plane[known, 0], limits[known, 0], limits[known, 1])
        found = replace(found, plane=plane)
    found = _full_size(job, view, found, options, images)
    plane = np.where((found.cost <= options.max_cost)[..., None], found.plane, np.float32(0))
    plane[_speckles(plane[..., 0], options.min_speckle_px)] = 0.0
    depth, normal = depth_and_normal(plane, level_camera(job.views[view], 0).calibration)
    write_maps(job, view, depth, normal)


def _speckles(inverse_depth: NDArray[np.float32], min_speckle_px: int) -> NDArray[np.bool_]:
    """Pixels of connected pieces of fewer pixels, where neighbours of like depth (2 %) connect."""
    known = inverse_depth > 0
    steps = np.zeros(inverse_depth.shape, np.int16)
    if known.any():
        logs = np.log(inverse_depth[known])
        steps[known] = 1 + np.minimum((logs - logs.min()) / 0.002, 32000).astype(np.int16)
    cv2.filterSpeckles(steps, 0, min_speckle_px - 1, 10)
    removed: NDArray[np.bool_] = known & (steps == 0)
    return removed


def _kept_folder(job: MvsJob, options: PatchMatchOptions, seed: int) -> Path:
    """Where passes are kept; emptied if it holds those of another job or of other options."""
    digest = hashlib.sha256(job.boxes_in_world.tobytes() + job.points_in_world.tobytes())
    for view in job.views:
        digest.update(view.name.encode() + view.calibration.tobytes() + view.cam_from_world.tobytes())
    made_by = json.dumps([3, asdict(options), seed, job.sources, digest.hexdigest()], sort_keys=True)
    folder = job.workspace / "stereo" / "patchmatch"
    label = folder / "made_by.json"
    if folder.exists() and not (label.exists() and label.read_text() == made_by):
        shutil.rmtree(folder)
    folder.mkdir(parents=True, exist_ok=True)
    label.write_text(made_by)
    return folder


def _kept_file(folder: Path, number: int, view: int) -> Path:
    return folder / f"pass{number}_view{view:05d}.npz"


def _save(path: Path, found: Hypotheses) -> None:
    partial = path.with_name(f".{path.stem}.partial.npz")
    np.savez(partial, plane=found.plane, cost=found.cost, view=found.view)
    partial.replace(path)


def _load_plane(path: Path) -> NDArray[np.float32]:
    return _load(path).plane


def _load(path: Path) -> Hypotheses:
    with np.load(path) as data:
        return Hypotheses(plane=data["plane"], cost=data["cost"], view=data["view"])
