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


@njit(cache=True, inline="always")  # called, walks take a tenth longer
def _walk(
    heights: NDArray[np.float64],
    start: tuple[float, float, float],
    way: tuple[float, float, float],
    allowed: float,
    lowers: bool,
) -> bool:
    """Go along a line over columns, and lower those that it passes, or find out whether they hide its end.

    Args:
        heights: (X, Y) of the columns; lowered in place to where the line passes them, if that is wanted.
        start: x and y in columns from the corner of the first one, z as in ``heights``.
        way: From the start to the end of the line, the same.
        allowed: Which part of the line may be lower than the columns.
        lowers: What to do.

    Returns:
        Whether more of the line is lower than the columns; false if they are lowered.
    """
    num_x, num_y = heights.shape
    x, y, z = start
    dx, dy, dz = way
    enter, last = _clip(x, dx, num_x, 0.0, 1.0)
    enter, last = _clip(y, dy, num_y, enter, last)
    i, way_i, next_i, gap_i = _enter(x, dx, enter, num_x)
    j, way_j, next_j, gap_j = _enter(y, dy, enter, num_y)
    while enter <= last and 0 <= i < num_x and 0 <= j < num_y:
        leave = min(next_i, next_j, last)
        if lowers:
            heights[i, j] = min(heights[i, j], z + dz * enter, z + dz * leave)
        elif z + dz * 0.5 * (enter + leave) < heights[i, j]:
            allowed -= leave - enter
            if allowed < 0.0:
                return True
        if leave >= last:
            break
        enter = leave
        if next_i < next_j:
            i, next_i = i + way_i, next_i + gap_i
        else:
            j, next_j = j + way_j, next_j + gap_j
    return False


@njit(cache=True, nogil=True)
def lower_to_rays(
    heights: NDArray[np.float64],
    centers: NDArray[np.float64],
    points: NDArray[np.float64],
    ray_centers: NDArray[np.integer],
    ray_points: NDArray[np.integer],
    corner_m: NDArray[np.float64],
    column_m: float,
    gap_m: float,
) -> None:
    """Lower each column to the lowest place where a ray passes it.

    Args:
        heights: (X, Y) of the columns in metres; changed in place.
        centers: (N, 3) of cameras, in the world.
        points: (P, 3) in the world.
        ray_centers: (T,) rows of the centres where rays start.
        ray_points: (T,) rows of the points where they end.
        corner_m: (2,) lowest x and y of the first column.
        column_m: Side of a column.
        gap_m: How far before its point a ray ends.
    """
    for ray in range(len(ray_points)):
        center, point = centers[ray_centers[ray]], points[ray_points[ray]]
        dx, dy, dz = point[0] - center[0], point[1] - center[1], point[2] - center[2]
        length_m = np.sqrt(dx * dx + dy * dy + dz * dz)
        if length_m <= gap_m:
            continue
        part = 1.0 - gap_m / length_m
        start = (center[0] - corner_m[0]) / column_m, (center[1] - corner_m[1]) / column_m, center[2]
        _walk(heights, start, (part * dx / column_m, part * dy / column_m, part * dz), 0.0, True)


@njit(cache=True)
def _is_hidden(
    tops: NDArray[np.float64], center: NDArray[np.float64], point: NDArray[np.float64], max_solid: float
) -> bool:
    """Whether the straight line between a camera and a point runs too far through solid columns; see below."""
    x, y, z = center
    dx, dy, dz = point[0] - x, point[1] - y, point[2] - z
    allowed = max_solid / max(np.sqrt(dx * dx + dy * dy), 1e-9)
    return _walk(tops, (x, y, z), (dx, dy, dz), allowed, False)


@njit(cache=True, nogil=True)
def clear_hidden(
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
    for camera in range(len(centers)):
        for point in range(len(points)):
            bit = np.uint64(1) << np.uint64(point % 64)
            if seen[camera, point // 64] & bit and _is_hidden(tops, centers[camera], points[point], max_solid):
                seen[camera, point // 64] &= ~bit


@njit(cache=True, nogil=True)
def see_any(
    seen: NDArray[np.uint64],
    tops: NDArray[np.float64],
    centers: NDArray[np.float64],
    points: NDArray[np.float64],
    max_solid: float,
) -> NDArray[np.bool_]:
    """(N,) which cameras `clear_hidden` would leave a point; each is asked only until one is found."""
    out = np.zeros(len(centers), np.bool_)
    for camera in range(len(centers)):
        for point in range(len(points)):
            bit = np.uint64(1) << np.uint64(point % 64)
            if seen[camera, point // 64] & bit and not _is_hidden(tops, centers[camera], points[point], max_solid):
                out[camera] = True
                break
    return out
