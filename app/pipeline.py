"""The chain of `full`, from images to the cloud of the town, and its dense parts as commands of their own."""

from __future__ import annotations

import logging
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

from app.capture.capture import capture
from app.capture.describe import describe
from app.comparison import compare_files
from app.dense_stages import batch_jobs, check_backend, cluster_jobs, densify_stage, densify_work, fuse_stage
from app.errors import CityReconError, InputError
from app.log import format_seconds
from app.run import Run
from app.stage import RECORD, StageRecord
from app.stages import (
    CaptureSources,
    capture_stage,
    cluster_stage,
    georegister_stage,
    select_stage,
    sfm_stage,
)
from fusion.open3d_import import import_open3d

logger = logging.getLogger(__name__)


def full_pipeline(
    run: Run,
    sources: CaptureSources,
    *,
    out: Path,
    poses: Path | None,
    model: Path | None,
    compare_batch: bool,
    allow_partial: bool,
) -> None:
    """Everything, from images to ``out``.

    Raises:
        CityReconError: a stage failed.
    """
    start = time.monotonic()
    check_output(out)
    check_backend(run)
    if compare_batch:
        import_open3d()
    logger.info("workspace: %s", run.workspace.root)
    _announce(1, "capture: taking stock of the images")
    capture_stage(run, sources)
    _announce(2, "sfm: finding poses and sparse points")
    sfm_stage(run, model=model, poses=poses)
    _announce(3, "georegister: turning the model to z up and metres")
    georegister_stage(run)
    _announce(4, "cluster: cutting the town into clusters")
    cluster_stage(run)
    _announce(5, "select: choosing views")
    select_stage(run)
    _announce(6, "densify: estimating depth and normal maps")
    jobs = cluster_jobs(run)
    densify_clusters(run, jobs, allow_partial=allow_partial)
    _announce(7, "fuse: depth maps to one cloud")
    fuse_clusters(run, jobs, out=out, allow_partial=allow_partial)
    if compare_batch:
        _announce(8, "batch: reconstructing the whole set at once, to compare")
        batch = run.workspace.batch_cloud_file
        batch_reconstruction(run, out=batch)
        comparison = run.workspace.root / "compare"
        comparison.mkdir(exist_ok=True)
        text = compare_files(
            out,
            batch,
            mesh=None,
            json_file=comparison / "merged_against_batch.json",
            picture=comparison / "merged_against_batch.png",
            options=run.config.compare,
        )
        logger.info("%s\nfigures and picture in %s", text, comparison)
    logger.info("done in %s", format_seconds(time.monotonic() - start))


def plan_full(run: Run, sources: CaptureSources, *, out: Path) -> None:
    """Check the input and say what `full_pipeline` would do.

    Raises:
        InputError: it couldn't begin.
    """
    check_output(out)
    check_backend(run)
    with tempfile.TemporaryDirectory() as scratch:
        inventory = capture(
            sources.images,
            Path(scratch),
            options=run.config.capture,
            gps_file=sources.gps,
            rig_file=sources.rig,
            mask_dir=sources.masks,
        )
    logger.info("%s", describe(inventory))
    for stage in ("capture", "sfm", "georegister", "clusters", "selection"):
        record = StageRecord.read(run.workspace.root / stage)
        state = (
            "to do" if record is None else f"done before in {format_seconds(record.seconds)}, kept if nothing changed"
        )
        logger.info("%-12s %s", stage, state)
    done = len(list((run.workspace.root / "dense").glob(f"*/{RECORD}")))
    logger.info("%-12s %s", "dense", f"{done} clusters done before" if done else "to do")
    logger.info("would write  %s", out)


def _announce(number: int, text: str) -> None:
    logger.info("[%d] %s", number, text)


def check_output(out: Path) -> None:
    """Refuse an output that can't be written, before hours of work.

    Raises:
        InputError: its folder doesn't exist or can't be written, or it is a folder.
    """
    if out.suffix.lower() != ".ply":
        raise InputError(f"{out}: the output must end in .ply")
    if out.is_dir():
        raise InputError(f"{out} is a folder; name a file that ends in .ply")
    if not out.parent.is_dir():
        raise InputError(f"folder {out.parent} doesn't exist; create it or choose another output")
    try:
        # Asking for permissions isn't enough: root has them all, also where nothing can be written.
        with tempfile.TemporaryFile(dir=out.parent):
            pass
    except OSError as error:
        raise InputError(f"folder {out.parent} can't be written: {error.strerror}; choose another output") from error


def densify_clusters(run: Run, jobs: Mapping[str, Path], *, allow_partial: bool, dry_run: bool = False) -> None:
    """Depth and normal maps of every cluster, or how much work that is."""
    if dry_run:
        _log_work(run, jobs, run.workspace.root / "dense")
        return
    failures = densify_stage(run, jobs=jobs, folder=run.workspace.root / "dense", num_jobs=run.num_jobs)
    _check(failures, len(jobs), allow_partial=allow_partial)


def fuse_clusters(run: Run, jobs: Mapping[str, Path], *, out: Path, allow_partial: bool) -> None:
    """One cloud of all clusters."""
    failures = fuse_stage(
        run,
        jobs=jobs,
        dense=run.workspace.root / "dense",
        folder=run.workspace.root / "fused",
        out=out,
        num_jobs=run.num_jobs,
        allow_partial=allow_partial,
    )
    _check(failures, len(jobs), allow_partial=allow_partial)


def batch_reconstruction(run: Run, *, out: Path, dry_run: bool = False) -> None:
    """One cloud of the whole set at once, or how much work that is."""
    folder = run.workspace.root / "batch"
    jobs = batch_jobs(run)
    if dry_run:
        _log_work(run, jobs, folder / "dense")
        return
    _check(densify_stage(run, jobs=jobs, folder=folder / "dense", num_jobs=1), 1, allow_partial=False)
    failures = fuse_stage(
        run,
        jobs=jobs,
        dense=folder / "dense",
        folder=folder / "fused",
        out=out,
        num_jobs=1,
        allow_partial=False,
    )
    _check(failures, 1, allow_partial=False)


def _log_work(run: Run, jobs: Mapping[str, Path], folder: Path) -> None:
    work = densify_work(run, jobs=jobs, folder=folder)
    logger.info(
        "densify: %d of %d jobs to do, %d depth maps of %.1f megapixels in all; back-end %s",
        work.num_jobs,
        len(jobs),
        work.num_views,
        work.megapixels,
        run.config.densify.backend,
    )


def _check(failures: Mapping[str, str], total: int, *, allow_partial: bool) -> None:
    """Go on without the clusters that failed if that is allowed.

    Raises:
        CityReconError: some failed and that isn't allowed, or all failed.
    """
    if not failures:
        return
    name, reason = next(iter(failures.items()))
    message = f"{len(failures)} of {total} clusters failed, first {name}: {reason}"
    if not allow_partial or len(failures) == total:
        raise CityReconError(f"{message}; run the same command again to retry them, or add --allow-partial")
    logger.warning("%s; going on without them", message)
