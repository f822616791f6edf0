"""The embedded CPU back-end."""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path

from mvs_backends.base import Availability, MvsBackend, MvsJob, MvsOptions, Progress
from mvs_backends.colmap_maps import has_maps
from mvs_backends.patchmatch.images import ImageCache
from mvs_backends.patchmatch.kernels import sweep_rows
from mvs_backends.patchmatch.options import PatchMatchOptions, options_of_preset
from mvs_backends.patchmatch.passes import Passes
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

    Every pass runs over all views before the next one begins, since it may need what the one before left for any view.
    What passes found is kept in `stereo/patchmatch/` until all is done.

    Raises:
        MvsError: an image or mask can't be read.
    """
    num_views = len(job.views)
    if all(has_maps(job, view) for view in range(num_views)):
        return
    folder = _kept_folder(job, options, seed)
    with ThreadPoolExecutor(num_threads) as executor:
        passes = Passes(
            job=job, options=options, seed=seed, images=ImageCache(job), folder=folder, executor=executor
        ).in_order()
        before = 0.0
        for number, part in enumerate(passes):
            for view in range(num_views):
                if not part.is_done(view):
                    started = time.perf_counter()
                    part.run(view)
                    seconds = time.perf_counter() - started
                    logger.debug("%s: pass %d of %d in %.1f s", job.views[view].name, number + 1, len(passes), seconds)
                if progress is not None:
                    progress(int((before + part.share * (view + 1) / num_views) * num_views + 1e-6), num_views)
            before += part.share
    shutil.rmtree(folder)


def _kept_folder(job: MvsJob, options: PatchMatchOptions, seed: int) -> Path:
    """Where passes are kept; emptied if it holds those of another job or of other options."""
    digest = hashlib.sha256(job.boxes_in_world.tobytes() + job.points_in_world.tobytes())
    for view in job.views:
        digest.update(view.name.encode() + view.calibration.tobytes() + view.cam_from_world.tobytes())
    made_by = json.dumps([4, asdict(options), seed, job.sources, digest.hexdigest()], sort_keys=True)
    folder = job.workspace / "stereo" / "patchmatch"
    label = folder / "made_by.json"
    if folder.exists() and not (label.exists() and label.read_text() == made_by):
        shutil.rmtree(folder)
    folder.mkdir(parents=True, exist_ok=True)
    label.write_text(made_by)
    return folder
