"""Rigid alignment of a reconstruction to its truth, by camera positions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusion.cloud import PointCloud

Motion = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Rotation (3, 3) and translation (3,)."""


def fit_rigid(source: NDArray[np.float64], target: NDArray[np.float64]) -> Motion:
    """Least-squares rotation and translation, no scale, between (N, 3) positions (Kabsch 1976)."""
    center_source, center_target = source.mean(axis=0), target.mean(axis=0)
    u, _, vt = np.linalg.svd((target - center_target).T @ (source - center_source))
    rotation = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    return rotation, center_target - rotation @ center_source


def position_errors(source: NDArray[np.float64], target: NDArray[np.float64], motion: Motion) -> NDArray[np.float64]:
    """(N,) distances after the motion."""
    rotation, translation = motion
    errors: NDArray[np.float64] = np.linalg.norm(source @ rotation.T + translation - target, axis=1)
    return errors


def moved(cloud: PointCloud, motion: Motion) -> PointCloud:
    """The points of a cloud after the motion, without normals and colours."""
    rotation, translation = motion
    return PointCloud((cloud.points @ rotation.T + translation).astype(np.float32))
