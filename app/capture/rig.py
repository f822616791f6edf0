"""Rig calibration in COLMAP's rig_config.json."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap

from app.errors import InputError


def read_rig_file(path: Path) -> list[pycolmap.RigConfig]:
    """Read and check a rig configuration.

    Raises:
        InputError: it can't be read, has no rig, or a camera's pose or parameters are no such.
    """
    try:
        rigs: list[pycolmap.RigConfig] = pycolmap.read_rig_config(path)
    except (OSError, ValueError, RuntimeError) as error:
        raise InputError(
            f"{path} is not a COLMAP rig configuration ({' '.join(str(error).split())}); see COLMAP's rig_config.json"
        ) from error
    if not rigs:
        raise InputError(f"{path} holds no rig; see COLMAP's rig_config.json")
    for camera in (camera for rig in rigs for camera in rig.cameras):
        pose = camera.cam_from_rig
        if pose is not None:
            quaternion, translation = np.asarray(pose.rotation.quat), np.asarray(pose.translation)
            if not np.isfinite(translation).all() or not abs(float(np.linalg.norm(quaternion)) - 1.0) < 0.02:
                raise InputError(
                    f"{path}: the pose of {camera.image_prefix!r} is not a unit quaternion and a translation"
                )
        if camera.camera is not None and not camera.camera.verify_params():
            raise InputError(
                f"{path}: camera_model_name and camera_params of {camera.image_prefix!r} don't go together"
            )
    return rigs


def check_prefixes(path: Path, rigs: Sequence[pycolmap.RigConfig], image_names: Sequence[str]) -> None:
    """Refuse a rig none of whose images are there, one prefix after the other.

    Raises:
        InputError: naming the first prefix that no image name starts with.
    """
    for camera in (camera for rig in rigs for camera in rig.cameras):
        if not any(name.startswith(camera.image_prefix) for name in image_names):
            raise InputError(
                f"{path}: no image name starts with its image_prefix {camera.image_prefix!r} "
                f"(first image {image_names[0]}); correct the prefix"
            )
