"""An existing COLMAP model in place of structure-from-motion."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path, PurePosixPath

import numpy as np
import pycolmap

from app.capture.inventory import CameraEntry, Inventory
from app.errors import InputError
from app.sfm.isolated import run_isolated
from app.sfm.report import SfmReport, make_report
from app.workspace import remove_tree

logger = logging.getLogger(__name__)

Progress = Callable[[int, int], None]
_PLACES = (".", "sparse", "sparse/0", "0")
_MIN_PRESENT_RATIO = 0.5
"""With fewer of a model's images there, it is a model of something else."""


def import_model(model_dir: Path, output: Path, *, inventory: Inventory | None = None) -> SfmReport | None:
    """Take over a COLMAP model, text or binary, of COLMAP 3 or 4, checked.

    Leaves `output/model` and, with an inventory, `output/report.json`. Images of the model that are not in the
    inventory are left out with a warning.

    Args:
        model_dir: folder with cameras, images and points3D, or a folder above it (`sparse`, `sparse/0`).
        output: folder.
        inventory: the images; without it names and numbers are checked only.

    Returns:
        What was imported, if there is an inventory.

    Raises:
        InputError: no model there, an empty one, numbers that are not finite, names that leave the image folder, other
            images or image sizes than in the inventory.
    """
    output.mkdir(parents=True, exist_ok=True)
    source = _find(model_dir)
    return run_isolated(_import, source, output, inventory, log_file=output / "colmap.log")


def _find(model_dir: Path) -> Path:
    for place in _PLACES:
        folder = model_dir / place
        for suffix in ("bin", "txt"):
            if all((folder / f"{stem}.{suffix}").is_file() for stem in ("cameras", "images", "points3D")):
                return folder
    raise InputError(f"{model_dir} holds no COLMAP model (cameras, images and points3D as .bin or .txt)")


def _import(source: Path, output: Path, inventory: Inventory | None, progress: Progress) -> SfmReport | None:
    try:
        model = pycolmap.Reconstruction(source)
    except (ValueError, RuntimeError, IndexError, OSError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{source} is not a readable COLMAP model ({reason}); export it again") from error
    _check_names(model, source)
    _check_numbers(model, source)
    if inventory is not None:
        model = _match_inventory(model, inventory, source)
    remove_tree(output / "model")
    (output / "model").mkdir()
    model.write_binary(output / "model")
    if inventory is None:
        return None
    report = make_report(model, inventory, used="imported", given_poses=[])
    report.write(output / "report.json")
    logger.info("%s", report.describe())
    return report


def _check_names(model: pycolmap.Reconstruction, source: Path) -> None:
    for image in model.images.values():
        path = PurePosixPath(image.name.replace("\\", "/"))
        if not image.name or path.is_absolute() or ".." in path.parts or ":" in path.parts[0]:
            raise InputError(f"{source}: image name {image.name!r} leaves the image folder; rename it in the model")


def _check_numbers(model: pycolmap.Reconstruction, source: Path) -> None:
    if not model.num_reg_images() or not model.num_points3D():
        raise InputError(
            f"{source} is empty: {model.num_reg_images()} images with poses, {model.num_points3D()} points; map again"
        )
    for image_id in model.reg_image_ids():
        if not np.isfinite(model.image(image_id).cam_from_world().matrix()).all():
            raise InputError(f"{source}: the pose of {model.image(image_id).name} is not finite; map again")
    for camera in model.cameras.values():
        if not np.isfinite(camera.params).all() or not camera.verify_params() or camera.mean_focal_length() <= 0:
            raise InputError(f"{source}: the parameters of camera {camera.camera_id} are no such; map again")
    if not all(np.isfinite(point.xyz).all() for point in model.points3D.values()):
        raise InputError(f"{source}: some 3D points are not finite; map again")


def _match_inventory(model: pycolmap.Reconstruction, inventory: Inventory, source: Path) -> pycolmap.Reconstruction:
    """Check the model against the images that are there, and leave out what is not."""
    cameras = {camera.name: camera for camera in inventory.cameras}
    entries = {image: cameras[camera] for frame in inventory.frames for camera, image in frame.images.items()}
    registered = [model.image(image_id) for image_id in model.reg_image_ids()]
    missing = sorted(image.name for image in registered if image.name not in entries)
    if len(missing) > (1 - _MIN_PRESENT_RATIO) * len(registered):
        raise InputError(
            f"{source}: {len(missing)} of its {len(registered)} images are not in {inventory.image_root} "
            f"(first {missing[0]}); give the images the model was made from"
        )
    for image in registered:
        if image.name in entries:
            _check_size(model, image, entries[image.name], source)
    if missing:
        logger.warning(
            "%d of the model's %d images are not in %s (first %s); they are left out",
            len(missing),
            len(registered),
            inventory.image_root,
            missing[0],
        )
        _leave_out(model, set(missing))
    return model


def _check_size(model: pycolmap.Reconstruction, image: pycolmap.Image, entry: CameraEntry, source: Path) -> None:
    camera = model.camera(image.camera_id)
    if (camera.width, camera.height) != (entry.width, entry.height):
        raise InputError(
            f"{source}: {image.name} is {camera.width}x{camera.height} in the model, but "
            f"{entry.width}x{entry.height} in the folder; give the images the model was made from"
        )


def _leave_out(model: pycolmap.Reconstruction, names: set[str]) -> None:
    """Make single images of all frames, and take away the poses and observations of some images."""
    poses = {image_id: model.image(image_id).cam_from_world() for image_id in model.reg_image_ids()}
    for image in [image for image in model.images.values() if image.name in names]:
        for index in image.get_observation_point2D_idxs():
            model.delete_observation(image.image_id, index)
    rigs = {}
    for camera_id in sorted(model.cameras):
        rigs[camera_id] = pycolmap.Rig(rig_id=camera_id)
        rigs[camera_id].add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id))
    frames = []
    for image_id, image in sorted(model.images.items()):
        frame = pycolmap.Frame(frame_id=image_id, rig_id=image.camera_id)
        frame.add_data_id(image.data_id)
        if image_id in poses and image.name not in names:
            frame.rig_from_world = poses[image_id]
        frames.append(frame)
    model.set_rigs_and_frames(list(rigs.values()), frames)
