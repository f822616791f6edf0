"""Dense stages on a workspace: per cluster, merged into the city, and the whole set at once for comparison."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from app.capture.inventory import Inventory
from app.clustering.clusters import Clustering
from app.dense_job import DenseJob, write_dense_job
from app.densify import Task, densify_inputs, densify_job, densify_options, fuse_inputs, fuse_job, run_tasks
from app.errors import CityReconError, InputError
from app.executor import available_cores, split_cores
from app.log import ProgressLine
from app.options import DensifyOptions
from app.run import Run
from app.scene.model_pieces import binary_model, read_cameras
from app.scene.point_index import PointIndex
from app.scene.read_model import open_scene
from app.stage import finished_product, is_current, run_stage
from app.versions import program_version
from app.view_selection.selection import read_selections
from app.workspace import atomic_file, remove_tree
from fusion.merge import merge_clouds
from fusion.region import GroundRegion
from mvs_backends import choose_backend, get_backend
from mvs_backends.base import MvsBackend
from mvs_backends.hardware import chosen_gpus, deal_gpus, gpu_environment, memory_budget_gib

logger = logging.getLogger(__name__)


def _write_jobs(
    run: Run, folder: Path, jobs: Callable[[], Mapping[str, tuple[tuple[str, ...], GroundRegion]]]
) -> dict[str, Path]:
    """Write a job folder per name for given images and region.

    Returns:
        Job folder by name.
    """

    def work(partial: Path) -> None:
        scene = open_scene(run.workspace.scene)
        points = PointIndex(scene.points_in_world)
        with binary_model(run.workspace.georegistered_model) as model:
            cameras = list(read_cameras(model, run.workspace.georegistered_model).values())
        digests = {
            image.name: image.digest + image.mask_digest
            for image in Inventory.read(run.workspace.inventory_file).images
        }
        for name, (image_names, region) in jobs().items():
            remove_tree(partial / name)
            write_dense_job(
                partial / name,
                scene=scene,
                points=points,
                image_rows=scene.image_names.rows_of(image_names),
                region=region,
                cameras=cameras,
                digests=digests,
            )

    run_stage(
        folder,
        options={},
        inputs={
            "selection": finished_product(run.workspace.root / "selection", "select"),
            "clusters": finished_product(run.workspace.root / "clusters", "cluster"),
            "model": finished_product(run.workspace.root / "georegister", "georegister"),
            "images": finished_product(run.workspace.root / "capture", "capture"),
        }
        | program_version("jobs"),
        work=work,
        product=lambda made: "",
    )
    return {path.name: path for path in sorted(folder.iterdir()) if path.is_dir()}


def cluster_jobs(run: Run) -> dict[str, Path]:
    """Write one job folder per cluster that has views: its selected views, its cells."""

    def jobs() -> dict[str, tuple[tuple[str, ...], GroundRegion]]:
        clusters = Clustering.read(run.workspace.root / "clusters")
        regions = {cluster.name: cluster.region() for cluster in clusters.clusters}
        return {
            selection.cluster: (selection.image_names, regions[selection.cluster])
            for selection in read_selections(run.workspace.root / "selection")
            if selection.image_names
        }

    return _write_jobs(run, run.workspace.root / "jobs", jobs)


def batch_jobs(run: Run) -> dict[str, Path]:
    """Write the one job of a batch reconstruction: all views, all cells."""

    def jobs() -> dict[str, tuple[tuple[str, ...], GroundRegion]]:
        regions = [cluster.region() for cluster in Clustering.read(run.workspace.root / "clusters").clusters]
        region = GroundRegion(
            cells=tuple(sorted({cell for region in regions for cell in region.cells})),
            origin_m=regions[0].origin_m,
            cell_size_m=regions[0].cell_size_m,
            z_range_m=(min(r.z_range_m[0] for r in regions), max(r.z_range_m[1] for r in regions)),
            padding_m=regions[0].padding_m,
        )
        return {"all": (tuple(open_scene(run.workspace.scene).image_names), region)}

    return _write_jobs(run, run.workspace.root / "batch" / "jobs", jobs)


def densify_stage(run: Run, *, jobs: Mapping[str, Path], folder: Path, num_jobs: int) -> dict[str, str]:
    """Depth and normal maps of each job.

    Returns:
        Reason of failure by name of the jobs that failed.

    Raises:
        CityReconError: the back-end can't run here.
    """
    check_backend(run)
    inventory = Inventory.read(run.workspace.inventory_file)
    densify = _densify(run)
    backend = get_backend(densify.backend)
    environments: list[dict[str, str]] = []
    stereo = run.config.stereo
    if backend.uses_gpu:
        num_sharers = min(len(jobs), num_jobs or len(jobs))
        environments = [gpu_environment(gpus) for gpus in deal_gpus(chosen_gpus(stereo.gpu_index), num_sharers)]
        stereo = replace(stereo, gpu_index="-1")
    dense_jobs = {name: DenseJob.read(job) for name, job in jobs.items()}
    most = len(environments) or num_jobs or _num_fitting(backend, dense_jobs.values(), densify)
    num_workers, num_threads = split_cores(len(jobs), most)
    tasks = {
        name: Task(
            folder=folder / name,
            options=_densify_options(run),
            inputs=densify_inputs(job),
            arguments=(
                job,
                folder / name,
                inventory.image_root,
                inventory.mask_root,
                densify,
                stereo,
                num_threads,
            ),
            num_steps=len(dense_jobs[name].images),
        )
        for name, job in jobs.items()
    }
    _remove_strangers(folder, tasks)
    return run_tasks(
        "densify",
        densify_job,
        tasks,
        num_workers=num_workers,
        log_file=run.workspace.log_file,
        environments=environments,
        prepare=backend.prepare,
    )


def check_backend(run: Run) -> None:
    """Refuse a back-end that doesn't exist or can't run, before hours of other work.

    Raises:
        InputError: no such back-end.
        CityReconError: it can't run here.
    """
    name = _densify(run).backend
    try:
        availability = get_backend(name).availability(run.config.stereo)
    except ValueError as error:
        raise InputError(str(error)) from error
    if not availability.ok:
        raise CityReconError(f"back-end {name} can't run here: {availability.reason}")


@dataclass(frozen=True, kw_only=True)
class DensifyWork:
    """How much is left to do."""

    num_jobs: int
    num_views: int
    megapixels: float


def densify_work(run: Run, *, jobs: Mapping[str, Path], folder: Path) -> DensifyWork:
    """What `densify_stage` would have to do."""
    todo = [
        DenseJob.read(job)
        for name, job in jobs.items()
        if not is_current(folder / name, options=_densify_options(run), inputs=densify_inputs(job))
    ]
    pixels = 0.0
    for job in todo:
        for image in job.images:
            camera = job.cameras[image.camera_id]
            longer = max(camera.width, camera.height)
            scale = min(1.0, (run.config.densify.max_image_size_px or longer) / longer)
            pixels += scale**2 * camera.width * camera.height
    return DensifyWork(
        num_jobs=len(todo), num_views=sum(len(job.images) for job in todo), megapixels=round(pixels / 1e6, 2)
    )


def _densify(run: Run) -> DensifyOptions:
    """The options with the back-end that `auto` means here: a workspace's maps all come from one."""
    densify = run.config.densify
    return replace(densify, backend=choose_backend(densify.backend, run.config.stereo))


def _num_fitting(backend: MvsBackend, jobs: Collection[DenseJob], options: DensifyOptions) -> int:
    """How many of the jobs fit into memory side by side, at least one; 0: not known."""
    needed_gib = max((backend.memory_gib(len(job.images), job.largest_image_px(options)) for job in jobs), default=0.0)
    if not needed_gib:
        return 0
    budget_gib = memory_budget_gib(available_cores())
    fitting = max(1, min(available_cores(), int(budget_gib / needed_gib)))
    if fitting < min(available_cores(), len(jobs)):
        logger.info("clusters at a time: %d, as each may need %.1f of %.1f GiB", fitting, needed_gib, budget_gib)
    return fitting


def _densify_options(run: Run) -> dict[str, object]:
    return densify_options(_densify(run), run.config.stereo)


def fuse_stage(
    run: Run,
    *,
    jobs: Mapping[str, Path],
    dense: Path,
    folder: Path,
    out: Path,
    num_jobs: int,
    allow_partial: bool,
) -> dict[str, str]:
    """A cloud of each job, cropped to its cells, and all of them in one file.

    The file is written if all jobs succeed, or if ``allow_partial`` and some do.

    Returns:
        Reason of failure by name of the jobs that failed or have no depth maps.

    Raises:
        CityReconError: no job left a point.
    """
    unfinished = {
        name: "it has no depth maps for its present views and options; run `cityrecon densify` first"
        for name, job in jobs.items()
        if not is_current(dense / name, options=_densify_options(run), inputs=densify_inputs(job))
    }
    tasks = {
        name: Task(
            folder=folder / name,
            options=run.config.fusion,
            inputs=fuse_inputs(dense / name),
            arguments=(job, dense / name, folder / name, run.config.fusion),
            num_steps=1,
        )
        for name, job in jobs.items()
        if name not in unfinished
    }
    _remove_strangers(folder, tasks)
    failures = run_tasks(
        "fuse", fuse_job, tasks, num_workers=split_cores(len(tasks), num_jobs)[0], log_file=run.workspace.log_file
    )
    failures = unfinished | failures
    if failures and not allow_partial:
        return failures
    clouds = [folder / name / "cloud.ply" for name in sorted(tasks) if name not in failures]
    filled = [cloud for cloud in clouds if cloud.exists()]
    for cloud in clouds:
        if not cloud.exists():
            logger.warning("%s: empty, its views agreed on no point", cloud.parent.name)
    if not filled:
        raise CityReconError(f"no cluster left a point, {out} not written; see {run.workspace.log_file}")
    with atomic_file(out) as partial:
        num_points = merge_clouds(filled, partial, progress=ProgressLine("merge"))
    logger.info("%s: %s points from %d of %d clusters", out, f"{num_points:,}", len(filled), len(jobs))
    return failures


def _remove_strangers(folder: Path, tasks: Mapping[str, Task]) -> None:
    """Remove what earlier options left: folders of clusters that are no more."""
    if folder.exists():
        for path in folder.iterdir():
            if path.name.removesuffix(".partial") not in tasks:
                remove_tree(path)
