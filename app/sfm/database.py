"""The COLMAP database: opened even after a kill, one camera per image folder, and copies for mapping."""

from __future__ import annotations

import logging
import sqlite3
from collections.abc import Mapping
from pathlib import Path

import pycolmap

from app.capture.inventory import CameraEntry, Inventory
from app.capture.rig import read_rig_file
from app.errors import InputError
from app.sfm.options import SfmOptions

logger = logging.getLogger(__name__)

_GUESSED_FOCAL_FACTOR = 1.2
"""Focal length over the longer side where nothing is known; COLMAP's own guess."""
_MAPPING_TABLES = ("cameras", "images", "keypoints", "two_view_geometries")


def open_database(path: Path) -> pycolmap.Database:
    """Open or create a database; one that a killed process left corrupted is started anew."""
    if path.exists() and not _is_sound(path):
        logger.warning("%s is corrupted, perhaps by a killed run; starting it anew", path)
        remove_database(path)
    return pycolmap.Database.open(path)


def remove_database(path: Path) -> None:
    """Remove a database with SQLite's files beside it."""
    for suffix in ("", "-wal", "-shm", "-journal"):
        path.with_name(path.name + suffix).unlink(missing_ok=True)


def _is_sound(path: Path) -> bool:
    try:
        connection = sqlite3.connect(path)
        try:
            tables = {row[0] for row in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
            return (
                connection.execute("PRAGMA quick_check").fetchone()[0] == "ok" and {"images", "matches"} <= tables
            ) or not tables
        finally:
            connection.close()
    except sqlite3.DatabaseError:
        return False


def camera_of_images(inventory: Inventory) -> dict[str, str]:
    """Image name to camera name."""
    return {image: camera for frame in inventory.frames for camera, image in frame.images.items()}


def list_images(database: pycolmap.Database, inventory: Inventory, options: SfmOptions) -> None:
    """Write the inventory's cameras and images, in order of their names, unless they are there.

    Each image is a frame of its own here; rigs belong to the copies for mapping.

    Raises:
        InputError: see `camera_models`.
    """
    if database.num_images() == len(inventory.images):
        return
    database.clear_all_tables()
    cameras, of_image = camera_models(inventory, options), camera_of_images(inventory)
    with pycolmap.DatabaseTransaction(database):
        camera_ids, rig_ids = {}, {}
        for name in sorted(cameras):
            camera_ids[name] = database.write_camera(cameras[name])
            rig = pycolmap.Rig()
            rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_ids[name]))
            rig_ids[name] = database.write_rig(rig)
        for name in sorted(image.name for image in inventory.images):
            camera_id = camera_ids[of_image[name]]
            image_id = database.write_image(pycolmap.Image(name=name, camera_id=camera_id))
            frame = pycolmap.Frame()
            frame.rig_id = rig_ids[of_image[name]]
            sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id)
            frame.add_data_id(pycolmap.data_t(sensor, image_id))
            database.write_frame(frame)


def camera_models(inventory: Inventory, options: SfmOptions) -> dict[str, pycolmap.Camera]:
    """COLMAP's camera of each camera folder: from the rig file, else `camera_params`, else with a prior focal length.

    Raises:
        InputError: the parameters don't fit the camera model or the image size.
    """
    calibrated = calibrated_cameras(inventory)
    return {entry.name: _camera_model(entry, calibrated, options) for entry in inventory.cameras}


def calibrated_cameras(inventory: Inventory) -> dict[str, pycolmap.Camera]:
    """Cameras whose intrinsics the rig file gives, by camera name."""
    if inventory.rig_file is None:
        return {}
    names = {entry.name for entry in inventory.cameras}
    return {
        camera.image_prefix.rstrip("/"): camera.camera
        for rig in read_rig_file(inventory.rig_file)
        for camera in rig.cameras
        if camera.camera is not None and camera.image_prefix.rstrip("/") in names
    }


def _camera_model(
    entry: CameraEntry, calibrated: Mapping[str, pycolmap.Camera], options: SfmOptions
) -> pycolmap.Camera:
    model = calibrated[entry.name].model_name if entry.name in calibrated else options.camera_model
    focal_px = entry.focal_prior_px or _GUESSED_FOCAL_FACTOR * max(entry.width, entry.height)
    camera = pycolmap.Camera.create_from_model_name(0, model, focal_px, entry.width, entry.height)
    camera.has_prior_focal_length = entry.focal_prior_px is not None
    if entry.name in calibrated:
        camera.params = list(calibrated[entry.name].params)
        camera.has_prior_focal_length = True
        x, y = camera.principal_point_x, camera.principal_point_y
        if not (0 < x < entry.width and 0 < y < entry.height):
            raise InputError(
                f"the rig file's principal point ({x:g}, {y:g}) of {entry.name} lies outside its images of "
                f"{entry.width}x{entry.height}; calibrate at that size"
            )
    elif options.camera_params:
        camera.params = list(options.camera_params)
        camera.has_prior_focal_length = True
        if not camera.verify_params():
            raise InputError(
                f"camera_params has {len(options.camera_params)} numbers, but {model} takes {camera.params_info}"
            )
    return camera


def copy_for_mapping(database: Path, copy: Path) -> None:
    """Copy what mapping needs: cameras, images, keypoints and verified matches, but no rigs and frames."""
    remove_database(copy)
    pycolmap.Database.open(copy).close()
    connection = sqlite3.connect(copy)
    try:
        connection.execute("ATTACH ? AS source", (str(database),))
        with connection:
            for table in _MAPPING_TABLES:
                connection.execute(f"INSERT INTO main.{table} SELECT * FROM source.{table}")
    finally:
        connection.close()
