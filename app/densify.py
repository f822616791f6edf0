"""Dense reconstruction: one multi-view stereo job per cluster -> depth maps -> one cloud per cluster -> the city."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from app.dense_job import DenseJob, prepare_workspace
from app.executor import run_jobs
from app.log import ProgressLine
from app.options import DensifyOptions
from app.stage import StageRecord, digest_files, is_current, run_stage
from app.versions import program_version
from fusion.cloud import write_ply
from fusion.depth_fusion import FusionOptions, fuse_depth_maps
from fusion.merge import crop_cloud
from fusion.thinning import thin
from mvs_backends import get_backend
from mvs_backends.base import MvsOptions

logger = logging.getLogger(__name__)

Report = Callable[[int, int], None]


def densify_job(
    job_folder: Path,
    output: Path,
    image_root: Path,
    mask_root: Path | None,
    densify: DensifyOptions,
    stereo: MvsOptions,
    num_threads: int,
    report: Report,
) -> None:
    """Leave a COLMAP dense workspace with depth and normal maps of one job in ``output``."""

    def work(partial: Path) -> None:
        job = prepare_workspace(
            job_folder,
            partial,
            image_root=image_root,
            mask_root=mask_root,
            options=densify,
        )
        get_backend(densify.backend).estimate(job=job, options=stereo, num_threads=num_threads, progress=report)

    run_stage(
        output,
        options=densify_options(densify, stereo),
        inputs=densify_inputs(job_folder),
        work=work,
        product=lambda folder: digest_files([folder / "stereo"]),
    )


def densify_options(densify: DensifyOptions, stereo: MvsOptions) -> dict[str, object]:
    """What a dense workspace depends on: not on where programs are, or how long they may take."""
    return {"densify": densify, "stereo": stereo.for_record()}


def densify_inputs(job_folder: Path) -> dict[str, str]:
    """What a dense workspace is made from."""
    return {"job": digest_files([job_folder])} | program_version("densify")


def fuse_job(job_folder: Path, dense: Path, output: Path, options: FusionOptions, report: Report) -> None:
    """Leave ``cloud.ply``, cropped to the job's cells, in ``output``; no file if no point was found."""
    region = DenseJob.read(job_folder).region

    def work(partial: Path) -> None:
        boxes = region.padded_boxes()
        bounds = np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])
        scratch = partial / "uncropped.ply"
        cloud = fuse_depth_maps(dense, scratch, options=options, bounds=bounds)
        for leftover in partial.glob("uncropped.ply*"):
            leftover.unlink()
        cloud = crop_cloud(cloud, region)
        if options.voxel_m:
            cloud = thin(cloud, options.voxel_m)
        if len(cloud):
            write_ply(partial / "cloud.ply", cloud)

    run_stage(
        output,
        options=options,
        inputs=fuse_inputs(dense),
        work=work,
        product=lambda folder: digest_files(folder.glob("cloud.ply")),
    )
    report(1, 1)


def fuse_inputs(dense: Path) -> dict[str, str]:
    """What a cluster's cloud is made from."""
    record = StageRecord.read(dense)
    return {"maps": record.product if record else "missing"} | program_version("fuse")


@dataclass(frozen=True, kw_only=True)
class Task:
    """A job for `run_tasks`: the folder it makes, and what that folder depends on."""

    folder: Path
    options: object
    inputs: Mapping[str, str]
    arguments: tuple[Any, ...]
    num_steps: int


def run_tasks(
    label: str,
    function: Callable[..., None],
    tasks: Mapping[str, Task],
    *,
    num_workers: int,
    log_file: Path,
    environments: Sequence[Mapping[str, str]] = (),
    prepare: Callable[[], None] | None = None,
) -> dict[str, str]:
    """Run the tasks whose folders aren't up to date, in processes of their own (see `run_jobs`), after ``prepare()``.

    Returns:
        Reason of failure by task name; empty if all succeeded.
    """
    todo = {name: t for name, t in tasks.items() if not is_current(t.folder, options=t.options, inputs=t.inputs)}
    if len(todo) < len(tasks):
        logger.info("%s: %d of %d already done", label, len(tasks) - len(todo), len(tasks))
    if not todo:
        return {}
    if prepare is not None:
        prepare()
    steps: Counter[str] = Counter()
    total = sum(task.num_steps for task in todo.values())
    line = ProgressLine(label)
    failures: dict[str, str] = {}

    def on_progress(name: str, done: int, of: int) -> None:
        steps[name] = todo[name].num_steps * done // max(of, 1)
        line(steps.total(), total)

    def on_done(name: str, reason: str | None) -> None:
        steps[name] = todo[name].num_steps
        line(steps.total(), total)
        if reason is not None:
            failures[name] = reason
            logger.error("%s: %s failed: %s", label, name, reason)

    run_jobs(
        function,
        {name: task.arguments for name, task in todo.items()},
        num_workers=num_workers,
        log_file=log_file,
        on_progress=on_progress,
        on_done=on_done,
        environments=environments,
    )
    return failures
