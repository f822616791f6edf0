"""Cameras of a pyramid level and the maps between a plane hypothesis, its depth and its normal."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mvs_backends.base import MvsView


@dataclass(frozen=True, kw_only=True)
class LevelCamera:
    """A view at the size of one pyramid level.

    The centre of the top-left pixel is (0, 0), unlike COLMAP's (0.5, 0.5).
    """

    width: int
    height: int
    calibration: NDArray[np.float64]
    """(3, 3)"""
    cam_from_world: NDArray[np.float64]
    """(3, 4)"""

    @property
    def center_in_world(self) -> NDArray[np.float64]:
        """(3,)"""
        center: NDArray[np.float64] = -self.cam_from_world[:, :3].T @ self.cam_from_world[:, 3]
        return center


def level_size(view: MvsView, level: int) -> tuple[int, int]:
    """Width and height of a view halved `level` times."""
    return max(1, round(view.width / 2**level)), max(1, round(view.height / 2**level))


def level_camera(view: MvsView, level: int) -> LevelCamera:
    """The camera of a view halved `level` times."""
    width, height = level_size(view, level)
    to_level = np.diag([width / view.width, height / view.height, 1.0])
    to_level[:2, 2] = -0.5
    return LevelCamera(
        width=width,
        height=height,
        calibration=to_level @ view.calibration,
        cam_from_world=view.cam_from_world,
    )


def warp(source: LevelCamera, reference: LevelCamera) -> NDArray[np.float32]:
    """(12,) A (row by row) and k of ``A (x, y, 1) + k w``: pixel and inverse depth to homogeneous source pixel."""
    rotation = source.cam_from_world[:, :3] @ reference.cam_from_world[:, :3].T
    translation = source.cam_from_world[:, 3] - rotation @ reference.cam_from_world[:, 3]
    linear = source.calibration @ rotation @ np.linalg.inv(reference.calibration)
    return np.concatenate([linear.ravel(), source.calibration @ translation]).astype(np.float32)


def depth_and_normal(
    plane: NDArray[np.float32], calibration: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Maps in COLMAP's terms of plane hypotheses.

    Args:
        plane: (H, W, 3) w, a, b; w = 0 where nothing is known.
        calibration: (3, 3), pixel centres at whole numbers.

    Returns:
        Depth (H, W) and unit normal (H, W, 3) in the camera's frame, towards the camera; both 0 where w is 0.
    """
    height, width = plane.shape[:2]
    w, a, b = np.moveaxis(plane, -1, 0)
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    slopes = np.stack([a, b, w - a * columns - b * rows], axis=-1)
    normal = -slopes @ calibration.astype(np.float32)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    known = (w > 0) & (length[..., 0] > 0)
    normal = np.where(known[..., None], normal / np.where(length > 0, length, 1), 0)
    depth = np.where(known, 1 / np.where(known, w, 1), 0)
    return depth.astype(np.float32), normal.astype(np.float32)
