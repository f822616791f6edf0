"""The stages on a workspace: each finds its inputs there, does its work once, and leaves its products there."""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass, replace
from pathlib import Path

from app.capture.inventory import Inventory
from app.clustering.map_labels import MapLabels
from app.executor import available_cores, split_cores
from app.georegister.georeference import Georeference
from app.log import ProgressLine
from app.run import Run
from app.stage import digest, digest_files, finished_product, run_stage
from app.versions import program_version
from app.workspace import Workspace

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class CaptureSources:
    """Files and folders that the user names."""

    images: Path
    gps: Path | None = None
    rig: Path | None = None
    masks: Path | None = None


def capture_stage(run: Run, sources: CaptureSources) -> None:
    """Take stock of the images, or extract frames from videos."""
    from app.capture.capture import capture
    from app.capture.describe import describe
    from app.capture.poses import is_pose_file

    def work(partial: Path) -> None:
        has_poses = sources.gps is not None and is_pose_file(sources.gps)
        capture(
            sources.images,
            partial,
            options=run.config.capture,
            gps_file=None if has_poses else sources.gps,
            pose_file=sources.gps if has_poses else None,
            rig_file=sources.rig,
            mask_dir=sources.masks,
            progress=ProgressLine("capture"),
        )

    run_stage(
        run.workspace.root / "capture",
        options=run.config.capture,
        inputs={
            name: _listing_digest(path)
            for name, path in (
                ("images", sources.images),
                ("GPS file", sources.gps),
                ("rig file", sources.rig),
                ("masks", sources.masks),
            )
        }
        | program_version("capture"),
        work=work,
        product=lambda folder: _inventory_digest(Inventory.read(folder / "inventory.json")),
    )
    logger.info("%s", describe(Inventory.read(run.workspace.inventory_file)))


def sfm_stage(run: Run, *, model: Path | None, poses: Path | None) -> None:
    """Poses and sparse points: from the images, from an existing model, or from the images with known poses."""
    from app.sfm.imports import import_model
    from app.sfm.stage import run_sfm

    inventory_product = finished_product(run.workspace.root / "capture", "capture")
    inventory = Inventory.read(run.workspace.inventory_file)

    def work(partial: Path) -> None:
        if model is not None:
            import_model(model, partial, inventory=inventory)
        else:
            run_sfm(inventory, partial, options=run.config.sfm, pose_file=poses, progress=ProgressLine("sfm"))

    run_stage(
        run.workspace.root / "sfm",
        options=run.config.sfm,
        inputs={
            "images": inventory_product,
            "imported model": digest_files([model]) if model else "none",
            "known poses": digest_files([poses]) if poses else "none",
        }
        | program_version("sfm"),
        work=work,
        product=lambda folder: digest_files([folder / "model"]),
    )


def plan_sfm(run: Run) -> None:
    """Say how much work `sfm_stage` has with the images."""
    from app.sfm.pairs import image_pairs

    finished_product(run.workspace.root / "capture", "capture")
    inventory = Inventory.read(run.workspace.inventory_file)
    pairs = image_pairs(inventory, run.config.sfm)
    strategies = ", ".join(run.config.sfm.strategies)
    logger.info(
        "sfm: features of %d images, %d pairs to match (and more where places look alike), then mapping by the first of"
        " these that registers %.0f %%: %s",
        len(inventory.images),
        len(pairs),
        100 * run.config.sfm.min_registered_ratio,
        strategies,
    )


def georegister_stage(run: Run) -> None:
    """Turn the model to z up, in metres, in ENU where GPS is known."""
    from app.georegister.georegister import georegister

    inventory = Inventory.read(run.workspace.inventory_file)
    model_product = finished_product(run.workspace.root / "sfm", "sfm")
    inventory_product = finished_product(run.workspace.root / "capture", "capture")
    run_stage(
        run.workspace.root / "georegister",
        options=run.config.georegister,
        inputs={"model": model_product, "images": inventory_product} | program_version("georegister"),
        work=lambda partial: georegister(
            run.workspace.sfm_model, inventory, partial, options=run.config.georegister, rig_file=inventory.rig_file
        ),
        product=lambda folder: digest_files([folder / "model", folder / "georeference.json"]),
    )


def cluster_stage(run: Run) -> None:
    """Cut the model into overlapping ground clusters ([O] section 3)."""
    from app.clustering.stage import cluster

    model_product = finished_product(run.workspace.root / "georegister", "georegister")
    run_stage(
        run.workspace.root / "clusters",
        options=run.config.clustering,
        inputs={"model": model_product} | program_version("cluster"),
        work=lambda partial: cluster(
            run.workspace.georegistered_model,
            partial,
            options=run.config.clustering,
            labels=map_labels(run.workspace),
            num_threads=split_cores(available_cores(), run.num_jobs)[0],
        ),
        product=lambda folder: digest_files([folder / "clusters.jsonl"]),
    )


def select_stage(run: Run) -> None:
    """Choose the smallest set of views of each cluster that still sees and matches everything ([O] section 4)."""
    from app.view_selection.stage import select

    clusters_product = finished_product(run.workspace.root / "clusters", "cluster")
    model_product = finished_product(run.workspace.root / "georegister", "georegister")
    run_stage(
        run.workspace.root / "selection",
        options=run.config.selection,
        inputs={"clusters": clusters_product, "model": model_product} | program_version("select"),
        work=lambda partial: select(
            run.workspace.root / "clusters",
            partial,
            options=run.config.selection,
            labels=map_labels(run.workspace),
            num_workers=split_cores(available_cores(), run.num_jobs)[0],
            progress=ProgressLine("select"),
        ),
        product=lambda folder: digest_files([folder / "selection.jsonl"]),
    )


def map_labels(workspace: Workspace) -> MapLabels:
    """What lengths are measured in and where y points, by the georeference."""
    found = Georeference.read(workspace.georeference_file)
    return MapLabels(unit="m" if found.is_metric else "steps", up="N" if found.origin_deg_m else "y")


def _inventory_digest(inventory: Inventory) -> str:
    """Hash of what was captured, wherever it lies."""
    return digest(
        replace(inventory, image_root=Path(), mask_root=None, rig_file=None),
        digest_files([inventory.rig_file]) if inventory.rig_file else "none",
    )


def _listing_digest(path: Path | None) -> str:
    """Hash of the names, sizes and times of a file or of all files in a folder: a false alarm costs little."""
    if path is None:
        return "none"
    files = [path]
    if path.is_dir():
        files = [Path(folder) / name for folder, _, names in os.walk(path) for name in names]
    states = []
    for file in sorted(files):
        try:
            state = file.stat()
        except OSError:
            continue
        states.append((os.fsencode(file).hex(), state.st_size, state.st_mtime_ns))
    return digest(str(path.resolve()), states)
