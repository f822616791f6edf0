"""Compiled walks along straight lines over columns of ground."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True)
def _clip(start: float, step: float, size: int, begin: float, end: float) -> tuple[float, float]:
    """The part of ``begin <= t <= end`` where ``0 <= start + t * step <= size``; where there is none, it ends before it
    begins."""
    if step == 0.0:
        return (begin, end) if 0.0 <= start <= size else (1.0, 0.0)
    low, high = -start / step, (size - start) / step
    return max(begin, min(low, high)), min(end, max(low, high))


@njit(cache=True)
def _enter(start: float, step: float, t: float, size: int) -> tuple[int, int, float, float]:
    """Along one axis, after Amanatides & Woo, A Fast Voxel Traversal Algorithm for Ray Tracing, 1987.

    Returns:
        The column at t, the way to the next one, where that one begins and how far apart the following ones are.
    """
    column = min(max(int(np.floor(start + t * step)), 0), size - 1)
    if step > 0.0:
        return column, 1, (column + 1 - start) / step, 1.0 / step
    if step < 0.0:
        return column, -1, (column - start) / step, -1.0 / step
    return column, 0, np.inf, np.inf


@njit(cache=True)
def lower_to_rays(heights: NDArray[np.float64], starts: NDArray[np.float64], ends: NDArray[np.float64]) -> None:
    """Lower each column to the lowest place where a ray passes it.

    Args:
        heights: (X, Y) of the columns; changed in place.
        starts: (T, 3) x and y in columns from the corner of the first one, z as in ``heights``.
        ends: (T, 3) the same.
    """
    num_x, num_y = heights.shape
    for ray in range(len(starts)):
        x, y, z = starts[ray]
        dx, dy, dz = ends[ray, 0] - x, ends[ray, 1] - y, ends[ray, 2] - z
        t, last = _clip(x, dx, num_x, 0.0, 1.0)
        t, last = _clip(y, dy, num_y, t, last)
        if last < t:
            continue
        i, way_i, next_i, gap_i = _enter(x, dx, t, num_x)
        j, way_j, next_j, gap_j = _enter(y, dy, t, num_y)
        while 0 <= i < num_x and 0 <= j < num_y:
            leave = min(next_i, next_j, last)
            heights[i, j] = min(heights[i, j], z + dz * t, z + dz * leave)
            if leave >= last:
                break
            t = leave
            if next_i < next_j:
                i += way_i
                next_i += gap_i
            else:
                j += way_j
                next_j += gap_j


@njit(cache=True)
def clear_blocked(
    seen: NDArray[np.uint64],
    tops: NDArray[np.float64],
    centers: NDArray[np.float64],
    points: NDArray[np.float64],
    max_solid: float,
) -> None:
    """Take from each camera the points to which the straight line runs too far through solid columns.

    Args:
        seen: (N, ceil(P / 64)) bit ``p % 64`` of word ``p // 64`` stands for point p; changed in place. Points whose
            bit isn't set cost nothing.
        tops: (X, Y) height below which each column is solid.
        centers: (N, 3) of the cameras; x and y in columns from the corner of the first one, z as in ``tops``.
        points: (P, 3) the same.
        max_solid: Length in columns, on the ground, of what may be solid along the line.
    """
    num_x, num_y = tops.shape
    for camera in range(len(centers)):
        x, y, z = centers[camera]
        for point in range(len(points)):
            bit = np.uint64(1) << np.uint64(point % 64)
            if not seen[camera, point // 64] & bit:
                continue
            dx, dy, dz = points[point, 0] - x, points[point, 1] - y, points[point, 2] - z
            t, last = _clip(x, dx, num_x, 0.0, 1.0)
            t, last = _clip(y, dy, num_y, t, last)
            if last < t:
                continue
            i, way_i, next_i, gap_i = _enter(x, dx, t, num_x)
            j, way_j, next_j, gap_j = _enter(y, dy, t, num_y)
            allowed = max_solid / max(np.sqrt(dx * dx + dy * dy), 1e-9)
            while 0 <= i < num_x and 0 <= j < num_y:
                leave = min(next_i, next_j, last)
                if z + dz * 0.5 * (t + leave) < tops[i, j]:
                    allowed -= leave - t
                    if allowed < 0.0:
                        seen[camera, point // 64] &= ~bit
                        break
                if leave >= last:
                    break
                t = leave
                if next_i < next_j:
                    i += way_i
                    next_i += gap_i
                else:
                    j += way_j
                    next_j += gap_j
