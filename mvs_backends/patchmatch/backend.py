"""The embedded CPU back-end."""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
import tempfile
from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict
from functools import partial
from pathlib import Path

from mvs_backends.base import Availability, MvsBackend, MvsJob, MvsOptions, Progress
from mvs_backends.colmap_maps import has_maps
from mvs_backends.hardware import memory_budget_gib
from mvs_backends.patchmatch.images import ImageCache, kept_bytes
from mvs_backends.patchmatch.kernels import sweep_rows
from mvs_backends.patchmatch.options import PatchMatchOptions, options_of_preset
from mvs_backends.patchmatch.passes import Pass, Passes
from mvs_backends.patchmatch.tiny_job import tiny_job

logger = logging.getLogger(__name__)
# Of the program; of a view that is worked on, beside the images kept.
_PROGRAM_GIB, _BYTES_PER_PX = 0.25, 250


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

    def memory_gib(self, num_views: int, image_px: int) -> float:
        """See `MvsBackend.memory_gib`."""
        return _PROGRAM_GIB + (kept_bytes(num_views, image_px) + _BYTES_PER_PX * image_px) / 2**30

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

    Every pass runs over all views before the next one begins, since it may need what the one before left for any view.
    What passes found is kept in `stereo/patchmatch/` until all is done.

    Raises:
        MvsError: an image or mask can't be read.
    """
    if not all(has_maps(job, view) for view in range(len(job.views))):
        _make_maps(job, options, seed, num_threads, progress)
    shutil.rmtree(_kept_folder(job), ignore_errors=True)


def _make_maps(job: MvsJob, options: PatchMatchOptions, seed: int, num_threads: int, progress: Progress | None) -> None:
    num_views = len(job.views)
    folder = _prepare_folder(job, options, seed)
    largest_px = max(view.width * view.height for view in job.views)
    free_bytes = memory_budget_gib(num_threads) * 2**30 - kept_bytes(num_views, largest_px)
    at_a_time = min(num_threads, max(1, int(free_bytes / (_BYTES_PER_PX * largest_px))))
    with ThreadPoolExecutor(num_threads) as executor, _views_executor(at_a_time) as views_executor:
        passes = Passes(job=job, options=options, seed=seed, images=ImageCache(job), folder=folder, executor=executor)
        before = 0.0
        for part in passes.in_order():
            for num_done, _ in enumerate(views_executor.map(partial(_run, part), range(num_views)), start=1):
                if progress is not None:
                    progress(int((before + part.share * num_done / num_views) * num_views + 1e-6), num_views)
            before += part.share


@contextmanager
def _views_executor(at_a_time: int) -> Iterator[Executor]:
    """Runs views side by side, as parts of their work use one thread only; drops those not begun at an error."""
    executor = ThreadPoolExecutor(at_a_time)
    try:
        yield executor
    finally:
        executor.shutdown(cancel_futures=True)


def _run(part: Pass, view: int) -> None:
    if not part.is_done(view):
        part.run(view)


def _prepare_folder(job: MvsJob, options: PatchMatchOptions, seed: int) -> Path:
    """Where passes are kept; emptied if it holds those of another job or of other options."""
    digest = hashlib.sha256(job.boxes_in_world.tobytes() + job.points_in_world.tobytes())
    for view in job.views:
        digest.update(view.name.encode() + view.calibration.tobytes() + view.cam_from_world.tobytes())
    made_by = json.dumps([8, asdict(options), seed, job.sources, digest.hexdigest()], sort_keys=True)
    folder = _kept_folder(job)
    label = folder / "made_by.json"
    if folder.exists() and not (label.exists() and label.read_text() == made_by):
        shutil.rmtree(folder)
    folder.mkdir(parents=True, exist_ok=True)
    label.write_text(made_by)
    return folder


def _kept_folder(job: MvsJob) -> Path:
    return job.workspace / "stereo" / "patchmatch"
