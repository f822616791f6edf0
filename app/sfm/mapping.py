"""Mapping by several strategies, tried in order until enough images register."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path

import pycolmap

from app.capture.inventory import Inventory
from app.sfm.database import calibrated_cameras, copy_for_mapping, remove_database
from app.sfm.options import SfmOptions, Strategy
from app.sfm.rigs import (
    RigSpec,
    database_ids,
    derive_rig,
    image_poses,
    pose_frames,
    rig_specs,
    scale_to_rigs,
    write_rigs,
)
from app.sfm.steadiness import num_steady_images, steady_cameras

logger = logging.getLogger(__name__)

Progress = Callable[[int, int], None]
_FILTER_REPROJECTION_PX = 4.0
_MIN_KEPT_OBSERVATIONS = 0.9
"""A rig that loses more of a model's observations than this doesn't fit the images."""


def map_images(
    strategy: Strategy,
    inventory: Inventory,
    database_path: Path,
    best: Path | None,
    output: Path,
    options: SfmOptions,
    progress: Progress,
) -> None:
    """Map by one strategy. Leaves models in `output/0`, `output/1` ... by size; none if it fails.

    Args:
        strategy: how.
        inventory: images and rigs.
        database_path: verified matches.
        best: the best model so far, for deriving a rig.
        output: created; holds a database for the time of mapping.
        options: thresholds, seed, threads.
        progress: called with images registered and images in all.
    """
    output.mkdir(parents=True, exist_ok=True)
    database = output / "mapping.db"
    copy_for_mapping(database_path, database)
    specs = rig_specs(inventory)
    if strategy is Strategy.GLOBAL_RIG:
        specs = tuple(spec for spec in (_calibrated(spec, best, inventory) for spec in specs) if spec is not None)
    with pycolmap.Database.open(database) as handle:
        write_rigs(handle, specs if strategy is Strategy.GLOBAL_RIG else (), inventory)
        fixed = fixed_cameras(handle, inventory, options)
        num_cameras = handle.num_cameras()
    pipeline = incremental_options(options, fixed)
    if strategy is Strategy.INCREMENTAL_FIXED:
        pipeline.ba_refine_extra_params = False
        pipeline.mapper.abs_pose_refine_extra_params = False
    if strategy in (Strategy.INCREMENTAL, Strategy.INCREMENTAL_FIXED):
        models = map_incrementally(database, inventory, output, pipeline, progress)
    else:
        models = _global(database, inventory, output, options, len(fixed) == num_cameras)
    if models and strategy is not Strategy.GLOBAL_RIG:
        largest = max(models, key=score)
        models = [mend(model, database, inventory, output, pipeline) if model is largest else model for model in models]
    remove_database(database)
    write_models(models, output)


def write_models(models: list[pycolmap.Reconstruction], output: Path) -> None:
    """Write models as `output/0`, `output/1` ..., largest first."""
    for index, model in enumerate(sorted(models, key=score, reverse=True)):
        folder = output / str(index)
        folder.mkdir(parents=True, exist_ok=True)
        model.write_binary(folder)


def score(model: pycolmap.Reconstruction) -> tuple[int, int]:
    """What makes a model better than another: registered images, then observations."""
    return model.num_reg_images(), model.compute_num_observations()


def _calibrated(spec: RigSpec, best: Path | None, inventory: Inventory) -> RigSpec | None:
    if spec.is_calibrated:
        return spec
    return derive_rig(spec, pycolmap.Reconstruction(best), inventory) if best is not None else None


def fixed_cameras(database: pycolmap.Database, inventory: Inventory, options: SfmOptions) -> set[int]:
    """COLMAP IDs of the cameras whose intrinsics are known and not to be refined."""
    if options.refine_known_intrinsics:
        return set()
    camera_ids, _ = database_ids(database, inventory)
    known = camera_ids if options.camera_params else calibrated_cameras(inventory)
    return {camera_ids[name] for name in known if name in camera_ids}


def mend(
    model: pycolmap.Reconstruction,
    database: Path,
    inventory: Inventory,
    output: Path,
    pipeline: pycolmap.IncrementalPipelineOptions,
) -> pycolmap.Reconstruction:
    """A model torn between its cameras, mapped on from those that hold together, if that helps; else as it was.

    Args:
        model: of single images.
        database: that it was mapped from.
        inventory: which images belong to a frame.
        output: for scratch.
        pipeline: changed to map one model.
    """
    steady = steady_cameras(model, inventory)
    camera_of_image = {image: camera for frame in inventory.frames for camera, image in frame.images.items()}
    torn = [i for i in model.reg_image_ids() if camera_of_image[model.image(i).name] not in steady]
    if not torn:
        return model
    logger.info("sfm: %d images moved relative to the others of their frames: registering them anew", len(torn))
    start = output / "steady"
    start.mkdir()
    rest = pycolmap.Reconstruction(model)
    for image_id in torn:
        rest.deregister_frame(rest.image(image_id).frame_id)
    rest.write_binary(start)
    pipeline.multiple_models = False
    mended = pycolmap.incremental_mapping(database, inventory.image_root, start, pipeline, input_path=start)
    shutil.rmtree(start)
    candidates = [model, *mended.values()]
    return max(candidates, key=lambda candidate: (num_steady_images(candidate, inventory), *score(candidate)))


def map_incrementally(
    database: Path,
    inventory: Inventory,
    output: Path,
    pipeline: pycolmap.IncrementalPipelineOptions,
    progress: Progress,
) -> list[pycolmap.Reconstruction]:
    """COLMAP's incremental mapping; ``output`` gets its models, ``progress`` images registered and in all."""
    registered, total = 0, len(inventory.images)

    def count() -> None:
        nonlocal registered
        registered += 1
        progress(min(registered, total), total)

    models = pycolmap.incremental_mapping(
        database, inventory.image_root, output, pipeline, initial_image_pair_callback=count, next_image_callback=count
    )
    return list(models.values())


def incremental_options(options: SfmOptions, fixed: set[int]) -> pycolmap.IncrementalPipelineOptions:
    """COLMAP's options with thresholds lowered for forward motion, where rays meet at small angles."""
    pipeline = pycolmap.IncrementalPipelineOptions()
    pipeline.random_seed = options.seed
    pipeline.num_threads = options.mapping_threads
    pipeline.constant_cameras = fixed
    pipeline.min_model_size = 3
    pipeline.mapper.init_min_tri_angle = options.init_min_tri_angle_deg
    pipeline.mapper.init_max_forward_motion = 1.0
    pipeline.mapper.init_min_num_inliers = 60
    pipeline.mapper.abs_pose_min_num_inliers = 20
    pipeline.mapper.filter_min_tri_angle = options.min_tri_angle_deg
    pipeline.triangulation.min_angle = options.min_tri_angle_deg
    return pipeline


def _global(
    database: Path, inventory: Inventory, output: Path, options: SfmOptions, all_known: bool
) -> list[pycolmap.Reconstruction]:
    pipeline = pycolmap.GlobalPipelineOptions()
    pipeline.random_seed = options.seed
    pipeline.num_threads = options.mapping_threads
    # A rig held fixed ends in a wrong scale: positions are solved for before the scale is known.
    pipeline.mapper.min_tri_angle_deg = options.min_tri_angle_deg
    if all_known:
        pipeline.mapper.bundle_adjustment.refine_focal_length = False
        pipeline.mapper.bundle_adjustment.refine_extra_params = False
    return list(pycolmap.global_mapping(database, inventory.image_root, output, pipeline).values())


def refine_with_rigs(
    inventory: Inventory, database_path: Path, source: Path, output: Path, options: SfmOptions, progress: Progress
) -> bool:
    """Map again with rigs, starting from a model's poses: known rigs are imposed, unknown ones derived from it.

    The model gets the scale of the known rigs. Images of a registered frame are all registered.

    Args:
        inventory: images and rigs.
        database_path: verified matches.
        source: a model without rigs.
        output: where the new model goes.
        options: what to refine.
        progress: called with rounds done and rounds in all.

    Returns:
        False, and no model, where the images contradict the rigs.
    """
    model = pycolmap.Reconstruction(source)
    known = rig_specs(inventory)
    scale = scale_to_rigs(known, model, inventory)
    if scale is not None:
        model.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d(), [0.0, 0.0, 0.0]))
    specs = [spec if spec.is_calibrated else derive_rig(spec, model, inventory) for spec in known]
    output.mkdir(parents=True, exist_ok=True)
    database = output / "mapping.db"
    copy_for_mapping(database_path, database)
    with pycolmap.Database.open(database) as handle:
        write_rigs(handle, [spec for spec in specs if spec is not None], inventory)
        fixed = fixed_cameras(handle, inventory, options)
        camera_ids, _ = database_ids(handle, inventory)
    rigged = load_unposed(database, dict(model.cameras))
    pose_frames(rigged, image_poses(model))
    constant = [
        camera_ids[name]
        for spec in specs
        if spec is not None and spec.is_metric and not options.refine_known_extrinsics
        for name in list(spec.cam_from_rig)[1:]
    ]
    for round_index in range(2):
        rigged = triangulate(rigged, database, inventory, output, options)
        adjust(rigged, fixed, constant, options, robust=round_index == 0)
        progress(round_index + 1, 2)
    remove_database(database)
    before, after = score(model), score(rigged)
    kept = after[1] >= _MIN_KEPT_OBSERVATIONS * before[1] and after[0] >= before[0]
    logger.debug("with rigs: %d images, %d observations; without: %d, %d", *after, *before)
    if kept:
        rigged.write_binary(output)
    return kept


def load_unposed(database: Path, cameras: Mapping[int, pycolmap.Camera]) -> pycolmap.Reconstruction:
    """Everything in a database as a model without poses and points, with the given intrinsics."""
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(database) as handle:
        model.load(pycolmap.DatabaseCache.create(handle, pycolmap.DatabaseCacheOptions(load_all_images=True)))
    for camera_id, camera in cameras.items():
        if camera_id in model.cameras:
            model.cameras[camera_id].params = list(camera.params)
    return model


def triangulate(
    model: pycolmap.Reconstruction, database: Path, inventory: Inventory, output: Path, options: SfmOptions
) -> pycolmap.Reconstruction:
    """Replace a model's points by ones triangulated with its poses."""
    return pycolmap.triangulate_points(
        model, database, inventory.image_root, output, clear_points=True, options=incremental_options(options, set())
    )


def adjust(
    model: pycolmap.Reconstruction,
    fixed: set[int],
    constant_sensors: list[int],
    options: SfmOptions,
    *,
    robust: bool,
    fix_poses: bool = False,
) -> None:
    """Bundle adjustment of everything, then filtering.

    Args:
        model: changed.
        fixed: cameras whose intrinsics stay.
        constant_sensors: cameras whose pose in their rig stays.
        options: threads and thresholds.
        robust: for a start far from the optimum.
        fix_poses: adjust only intrinsics and points.
    """
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    if fix_poses:
        for frame_id in model.reg_frame_ids():
            config.set_constant_rig_from_world_pose(frame_id)
    for camera_id in fixed:
        config.set_constant_cam_intrinsics(camera_id)
    for camera_id in constant_sensors:
        config.set_constant_sensor_from_rig_pose(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id))
    adjustment = pycolmap.BundleAdjustmentOptions(print_summary=False)
    adjustment.ceres.solver_options.num_threads = options.mapping_threads
    if robust:
        adjustment.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    pycolmap.create_default_bundle_adjuster(adjustment, config, model).solve()
    pycolmap.ObservationManager(model).filter_all_points3D(_FILTER_REPROJECTION_PX, options.min_tri_angle_deg)
    model.update_point_3d_errors()
