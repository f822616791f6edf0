"""Structure-from-Motion: images in, poses and sparse points out."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pycolmap

from app.capture.inventory import Inventory
from app.errors import CityReconError, DiskFullError, InputError
from app.sfm.agreement import positions_agree
from app.sfm.features import extract_features
from app.sfm.imports import import_model
from app.sfm.isolated import run_isolated
from app.sfm.known_poses import map_with_poses, read_known_poses
from app.sfm.mapping import map_images, refine_with_rigs, score
from app.sfm.matching import match_pairs
from app.sfm.options import SfmOptions, Strategy
from app.sfm.pairs import Pair, frame_positions_m, image_pairs
from app.sfm.report import Attempt, SfmReport, make_report
from app.sfm.retrieval import similar_pairs
from app.sfm.rigs import rig_specs
from app.sfm.steadiness import num_steady_images
from app.workspace import remove_tree

__all__ = ["import_model", "run_sfm"]

logger = logging.getLogger(__name__)

Progress = Callable[[int, int], None]
_MIN_LOCATED_RATIO = 0.5
"""With positions of more frames than this, positions alone close loops."""
_STEPS = 1000
_FEATURES, _MATCHES = 300, 700
"""Steps of progress after which features and matches are done."""


def run_sfm(
    inventory: Inventory,
    output: Path,
    *,
    options: SfmOptions,
    pose_file: Path | None = None,
    progress: Progress | None = None,
) -> SfmReport:
    """Find the poses of all images, the intrinsics of all cameras, and sparse points.

    Leaves `output/model` (the largest model), `output/components/K` (all of them, largest first), `output/database.db`,
    `output/report.json` and `output/colmap.log`. What a killed run left in `output` is used: features, matches, and
    finished strategies.

    Args:
        inventory: images, rigs, GPS.
        output: folder.
        options: see there.
        pose_file: known poses (COLMAP, TUM or KITTI format): only points are then computed.
        progress: called with steps done and steps in all.

    Raises:
        InputError: fewer than two images, or no two images show the same thing.
        CityReconError: no strategy works.
    """
    output.mkdir(parents=True, exist_ok=True)
    if len(inventory.images) < 2:
        raise InputError(f"{inventory.image_root} holds {len(inventory.images)} image; at least two are needed")
    database, log_file = output / "database.db", output / "colmap.log"
    poses = read_known_poses(pose_file, inventory) if pose_file is not None else None
    names = sorted(image.name for image in inventory.images)
    run_isolated(
        extract_features, inventory, database, options, log_file=log_file, progress=_part(progress, 0, _FEATURES)
    )
    pairs = _pairs(inventory, database, options)
    logger.info("sfm: matching %d pairs of %d images", len(pairs), len(names))
    run_isolated(
        match_pairs,
        database,
        names,
        pairs,
        options,
        log_file=log_file,
        progress=_part(progress, _FEATURES, _MATCHES),
    )
    _check_matches(database, inventory)
    tried = output / "tried"
    mapping_progress = _part(progress, _MATCHES, _STEPS)
    attempts: tuple[Attempt, ...] = ()
    used, folders = "known-poses", [tried / "poses"]
    if poses is not None:
        run_isolated(
            map_with_poses, inventory, database, poses, tried / "poses", options, log_file=log_file, progress=None
        )
    else:
        attempts, used, folders = _try_strategies(inventory, database, tried, options, log_file, mapping_progress)
    report = run_isolated(_finish, inventory, output, folders, used, attempts, poses, log_file=log_file)
    remove_tree(tried)
    if progress is not None:
        progress(_STEPS, _STEPS)
    logger.info("%s", report.describe())
    return report


def _pairs(inventory: Inventory, database: Path, options: SfmOptions) -> list[Pair]:
    located = np.isfinite(frame_positions_m(inventory.frames)).all(axis=1).mean() > _MIN_LOCATED_RATIO
    # Positions don't say which way a camera looks: that is known within a rig's frames, or when there is one camera.
    is_aligned = inventory.is_rig or len(inventory.cameras) == 1
    if len(inventory.images) <= options.max_exhaustive_images or (located and is_aligned):
        return image_pairs(inventory, options)
    return image_pairs(inventory, options, similar_pairs(database, inventory.frames, options))


def _part(progress: Progress | None, start: int, end: int) -> Progress | None:
    """Progress of one part of the work as steps of the whole."""
    if progress is None:
        return None
    return lambda done, total: progress(start + (end - start) * done // max(total, 1), _STEPS)


def _check_matches(database_path: Path, inventory: Inventory) -> None:
    with pycolmap.Database.open(database_path) as database:
        if not any(inliers > 0 for inliers in database.read_two_view_geometry_num_inliers()[1]):
            raise InputError(
                f"no two images in {inventory.image_root} show the same thing; give images that overlap by half or more"
            )


def _try_strategies(
    inventory: Inventory,
    database: Path,
    tried: Path,
    options: SfmOptions,
    log_file: Path,
    progress: Progress | None,
) -> tuple[tuple[Attempt, ...], str, list[Path]]:
    """Map until enough images register.

    A model that has images elsewhere than the best one before it is not used, unless that one was torn or registered
    less than half as many: what incremental mapping had right, global mapping has been metres off with.

    Returns:
        What was tried, the best strategy, and the folders of its models, the one to use first.
    """
    attempts: list[Attempt] = []
    best: tuple[Attempt, list[Path]] | None = None
    enough = options.min_registered_ratio * len(inventory.images)
    for strategy in options.strategies:
        if strategy is Strategy.GLOBAL_RIG and not rig_specs(inventory):
            continue
        best_folder = best[1][0] if best is not None else None
        folders, with_rig = _map(strategy, inventory, database, best_folder, tried, options, log_file, progress)
        models = [pycolmap.Reconstruction(folder) for folder in folders] or [pycolmap.Reconstruction()]
        registered, observations = score(models[0])
        attempt = Attempt(
            strategy=strategy,
            registered=registered,
            steady=num_steady_images(models[0], inventory),
            observations=observations,
            components=tuple(model.num_reg_images() for model in models),
            with_rig=with_rig,
            agrees=best_folder is None or positions_agree(pycolmap.Reconstruction(best_folder), models[0]),
        )
        attempts.append(attempt)
        logger.info("sfm: %s", attempt.describe(len(inventory.images)))
        if best is None:
            is_better = registered > 0
        elif attempt.agrees or best[0].is_torn or registered > 2 * best[0].registered:
            is_better = attempt.rank > best[0].rank
        else:
            is_better = False
        if is_better:
            best = attempt, folders
        if best is not None and best[0].steady >= enough:
            break
    if best is None:
        raise CityReconError(
            f"no strategy ({', '.join(options.strategies)}) finds poses for the images in {inventory.image_root}; "
            "they need more overlap, or known poses (--poses)"
        )
    if best[0].is_torn:
        logger.warning(
            "the cameras of %d images don't keep their places beside the others: their poses are wrong, or the cameras "
            "are no rig (then set capture.rig_mode=no)",
            best[0].registered - best[0].steady,
        )
    return tuple(attempts), best[0].strategy, best[1]


def _map(
    strategy: Strategy,
    inventory: Inventory,
    database: Path,
    best: Path | None,
    tried: Path,
    options: SfmOptions,
    log_file: Path,
    progress: Progress | None,
) -> tuple[list[Path], bool]:
    """One strategy, unless a killed run has finished it; then its largest model with the rig.

    Returns:
        Folders of the models, the one to use first, and whether that one has the rig.
    """
    folder, rigged = tried / strategy, tried / f"{strategy}-with-rig"
    done = tried / f"{strategy}.done"
    if not done.exists():
        remove_tree(folder)
        remove_tree(rigged)
        try:
            run_isolated(
                map_images, strategy, inventory, database, best, folder, options, log_file=log_file, progress=progress
            )
            if rig_specs(inventory) and (folder / "0").exists():
                kept = run_isolated(
                    refine_with_rigs, inventory, database, folder / "0", rigged, options, log_file=log_file
                )
                if not kept:
                    remove_tree(rigged)
                    logger.warning("the images contradict the rig; poses are kept as found without it")
        except (CityReconError, RuntimeError) as error:
            if isinstance(error, (InputError, DiskFullError)):
                raise
            logger.warning("sfm: %s failed: %s", strategy, str(error).strip().splitlines()[-1])
            remove_tree(rigged)
        done.touch()
    folders = sorted((path for path in folder.glob("*") if path.is_dir()), key=lambda path: int(path.name))
    if rigged.exists():
        folders = [rigged, *folders[1:]]
    return folders, rigged.exists()


def _finish(
    inventory: Inventory,
    output: Path,
    folders: Sequence[Path],
    used: str,
    attempts: Sequence[Attempt],
    poses: dict[str, pycolmap.Rigid3d] | None,
    progress: Progress,
) -> SfmReport:
    """Colour the points, write all models in order of size, and the report."""
    models = [pycolmap.Reconstruction(folder) for folder in folders]
    ordered = sorted(models, key=score, reverse=True)
    remove_tree(output / "components")
    for index, model in enumerate(ordered):
        model.extract_colors_for_all_images(inventory.image_root)
        folder = output / "components" / str(index)
        folder.mkdir(parents=True)
        model.write_binary(folder)
        progress(index + 1, len(ordered))
    remove_tree(output / "model")
    shutil.copytree(output / "components" / "0", output / "model")
    report = make_report(
        ordered[0],
        inventory,
        used=used,
        attempts=attempts,
        components=[[model.image(image_id).name for image_id in model.reg_image_ids()] for model in ordered],
        database_path=output / "database.db",
        given_poses=None if poses is None else list(poses),
    )
    report.write(output / "report.json")
    return report
