"""Alignment of a reconstruction to its truth, by camera positions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusion.cloud import PointCloud

Motion = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Rotation, maybe times a scale, (3, 3) and translation (3,)."""


def fit_rigid(
    source: NDArray[np.float64], target: NDArray[np.float64], rotation: NDArray[np.float64] | None = None
) -> Motion:
    """Least-squares rotation, unless it is given, and translation, no scale, between (N, 3) positions (Kabsch 1976)."""
    center_source, center_target = source.mean(axis=0), target.mean(axis=0)
    if rotation is None:
        rotation = _nearest_rotation((target - center_target).T @ (source - center_source))
    return rotation, center_target - rotation @ center_source


def fit_similarity(
    source: NDArray[np.float64], target: NDArray[np.float64], rotation: NDArray[np.float64] | None = None
) -> Motion:
    """The same with a scale, which is part of the returned matrix (Umeyama 1991)."""
    rotation, _ = fit_rigid(source, target, rotation)
    centered = (source - source.mean(axis=0)) @ rotation.T
    scale = float((centered * (target - target.mean(axis=0))).sum() / (centered**2).sum())
    return scale * rotation, target.mean(axis=0) - scale * rotation @ source.mean(axis=0)


def mean_rotation(source: NDArray[np.float64], target: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rotation (3, 3) that brings cameras' orientations (N, 3, 3), world_from_cam, nearest to others.

    Positions along a straight drive leave the roll free.
    """
    return _nearest_rotation(np.einsum("nij,nkj->ik", target, source))


def _nearest_rotation(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    u, _, vt = np.linalg.svd(matrix)
    rotation: NDArray[np.float64] = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    return rotation


def position_errors(source: NDArray[np.float64], target: NDArray[np.float64], motion: Motion) -> NDArray[np.float64]:
    """(N,) distances after the motion."""
    rotation, translation = motion
    errors: NDArray[np.float64] = np.linalg.norm(source @ rotation.T + translation - target, axis=1)
    return errors


def moved(cloud: PointCloud, motion: Motion) -> PointCloud:
    """The points of a cloud after the motion, without normals and colours."""
    rotation, translation = motion
    return PointCloud((cloud.points @ rotation.T + translation).astype(np.float32))
