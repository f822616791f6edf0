"""Planes interpolated between reliable points: the start from sparse points, and ACMP's planar prior."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_MAX_GREY_STEP = 25


def interpolated_planes(
    points: NDArray[np.float32],
    inverse_depths: NDArray[np.float32],
    width: int,
    height: int,
    grey: NDArray[np.uint8] | None = None,
) -> NDArray[np.float32]:
    """Planes through the Delaunay triangles of points in the image.

    Args:
        points: (P, 2) pixels, centres at whole numbers.
        inverse_depths: (P,)
        width: of the image.
        height: of the image.
        grey: (height, width) the image. If given, pixels whose grey value differs from all three corners of their
            triangle by more than 25 get no plane: between two houses that is the sky.

    Returns:
        (height, width, 3) inverse depth and its slopes along x and y; 0 outside the points' convex hull.
    """
    planes = np.zeros((height, width, 3), np.float32)
    cells = np.floor(points + 0.5).astype(np.int64)
    inside = np.all((cells >= 0) & (cells < [width, height]), axis=1)
    cells, inverse_depths = cells[inside], inverse_depths[inside]
    # One point per pixel, the nearest to the camera; also what finds a triangle's corners again.
    at_pixel = np.zeros((height, width), np.float32)
    np.maximum.at(at_pixel, (cells[:, 1], cells[:, 0]), inverse_depths)
    rows, columns = np.nonzero(at_pixel)
    if len(rows) < 3:
        return planes
    subdivision = cv2.Subdiv2D((0, 0, width, height))
    subdivision.insert([(float(x), float(y)) for x, y in zip(columns, rows, strict=True)])
    triangles = np.asarray(subdivision.getTriangleList(), np.float64).reshape(-1, 3, 2)
    whole = np.all((triangles >= 0) & (triangles < [width, height]), axis=(1, 2))
    corners = np.rint(triangles[whole]).astype(np.int32)
    index = np.full((height, width), -1, np.int32)
    for i, corner in enumerate(corners):
        cv2.fillConvexPoly(index, corner, i)
    values = at_pixel[corners[:, :, 1], corners[:, :, 0]].astype(np.float64)
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]).astype(np.float64)
    usable = (area != 0) & np.all(values > 0, axis=1)
    area[~usable] = 1.0
    rise, other = values[:, 1] - values[:, 0], values[:, 2] - values[:, 0]
    slope_x = (rise * second[:, 1] - other * first[:, 1]) / area
    slope_y = (other * first[:, 0] - rise * second[:, 0]) / area
    y, x = np.nonzero(index >= 0)
    y, x = (c[usable[index[y, x]]] for c in (y, x))
    at = index[y, x]
    planes[y, x, 1], planes[y, x, 2] = slope_x[at], slope_y[at]
    planes[y, x, 0] = values[at, 0] + slope_x[at] * (x - corners[at, 0, 0]) + slope_y[at] * (y - corners[at, 0, 1])
    planes[planes[..., 0] <= 0] = 0.0
    if grey is not None:
        at_corners = grey[corners[:, :, 1], corners[:, :, 0]].astype(np.int32)[at]
        alike = np.abs(at_corners - grey[y, x].astype(np.int32)[:, None]).min(axis=1) <= _MAX_GREY_STEP
        planes[y[~alike], x[~alike]] = 0.0
    return planes


def support_points(
    cost: NDArray[np.float32], inverse_depth: NDArray[np.float32], cell_px: int, max_cost: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """ACMP's credible points: the pixel of least cost of each cell, if that is at most `max_cost`.

    Returns:
        (P, 2) pixels and (P,) inverse depths.
    """
    height, width = cost.shape
    rows, columns = -(-height // cell_px), -(-width // cell_px)
    padded = np.full((rows * cell_px, columns * cell_px), np.inf, np.float32)
    padded[:height, :width] = np.where(inverse_depth > 0, cost, np.inf)
    cells = padded.reshape(rows, cell_px, columns, cell_px).transpose(0, 2, 1, 3).reshape(rows, columns, -1)
    best = cells.argmin(axis=-1)
    good = np.take_along_axis(cells, best[..., None], axis=-1)[..., 0] <= max_cost
    y = (np.arange(rows)[:, None] * cell_px + best // cell_px)[good]
    x = (np.arange(columns)[None, :] * cell_px + best % cell_px)[good]
    return np.stack([x, y], axis=1).astype(np.float32), inverse_depth[y, x]
