"""Uniform samples of a block, which stand for the surfaces that have no keypoint ([O] section 3)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def sample_axes(box: NDArray[np.float64], spacing: float) -> tuple[NDArray[np.float64], ...]:
    """Coordinates of the samples in a box along x, y and z; the samples are all combinations of the three.

    They divide each side evenly, at the spacing nearest to the one wanted, and lie half a step inside the box.

    Args:
        box: (2, 3) minimum and maximum corner.
        spacing: Sampling resolution r.
    """
    axes = []
    for low, high in box.T:
        count = max(1, round((high - low) / spacing))
        axes.append(low + (np.arange(count) + 0.5) * ((high - low) / count))
    return tuple(axes)


def grid_points(axes: tuple[NDArray[np.float64], ...]) -> NDArray[np.float64]:
    """(n, 3) all combinations of the coordinates of three axes."""
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def height_range(
    keypoint_heights: NDArray[np.float64],
    camera_heights: NDArray[np.float64],
    *,
    quantiles: tuple[float, float],
    margin: float,
    camera_height: float,
) -> tuple[float, float]:
    """Heights between which a block's surfaces lie.

    Args:
        keypoint_heights: (n,) of the keypoints in the block and its neighbours, so that a block with few keypoints
            borrows its neighbours' ground and roofs; at least one.
        camera_heights: (m,) of the cameras there; the ground is below them, also where it has no keypoints.
        quantiles: Which part of the keypoints' heights counts.
        margin: Added at both ends.
        camera_height: How far below the median camera the range reaches at least.
    """
    low, high = np.quantile(keypoint_heights, quantiles)
    if len(camera_heights):
        low = min(low, np.median(camera_heights) - camera_height)
    return float(low - margin), float(high + margin)
