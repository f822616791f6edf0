"""Whether the cameras of a rig keep their places relative to each other in a model that was mapped without the rig.

Moving cars and few matches between cameras can tear a model: each camera's drive is right in itself, but they run at
different scales. Neither registered images nor reprojection errors tell.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pycolmap
from numpy.typing import NDArray

from app.capture.inventory import Inventory
from app.sfm.rigs import image_poses

_MIN_SHARED_FRAMES = 3
_MAX_SPACINGS = 0.5
_MAX_EXTENT = 0.02


def steady_cameras(model: pycolmap.Reconstruction, inventory: Inventory) -> set[str]:
    """The cameras, with the most registered images, that keep their places relative to each other.

    Two cameras do if, for half of the frames and more, the second is at most half a frame's way from its usual
    place beside the first (firing at different moments does that), or at most 2 % of the drive's extent.
    Without three frames that have both, nothing speaks against it.

    Returns:
        Names of cameras; all of them where cameras are no rig.
    """
    names = [camera.name for camera in inventory.cameras]
    if not inventory.is_rig:
        return set(names)
    poses = image_poses(model)
    rows = {
        camera: {
            row: poses[frame.images[camera]]
            for row, frame in enumerate(inventory.frames)
            if frame.images.get(camera) in poses
        }
        for camera in names
    }
    group = {camera: {camera} for camera in names}
    for index, first in enumerate(names):
        for second in names[index + 1 :]:
            if group[first] is not group[second] and _is_steady(rows[first], rows[second]):
                merged = group[first] | group[second]
                group.update(dict.fromkeys(merged, merged))
    return max(group.values(), key=lambda cameras: (sum(len(rows[camera]) for camera in cameras), sorted(cameras)))


def num_steady_images(model: pycolmap.Reconstruction, inventory: Inventory) -> int:
    """Registered images of the `steady_cameras`."""
    poses, steady = image_poses(model), steady_cameras(model, inventory)
    return sum(
        camera in steady and image in poses for frame in inventory.frames for camera, image in frame.images.items()
    )


def _is_steady(first: Mapping[int, pycolmap.Rigid3d], second: Mapping[int, pycolmap.Rigid3d]) -> bool:
    shared = sorted(first.keys() & second.keys())
    if len(shared) < _MIN_SHARED_FRAMES:
        return True
    beside = np.array([(first[row] * second[row].inverse()).translation for row in shared])
    offsets = np.median(np.linalg.norm(beside - np.median(beside, axis=0), axis=1))
    centers = np.array([first[row].inverse().translation for row in shared])
    return bool(offsets <= max(_MAX_SPACINGS * _spacing(centers), _MAX_EXTENT * _extent(centers)))


def _spacing(centers: NDArray[np.float64]) -> float:
    return float(np.median(np.linalg.norm(np.diff(centers, axis=0), axis=1)))


def _extent(centers: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(centers - centers.mean(axis=0)) / np.sqrt(len(centers)))
