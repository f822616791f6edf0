"""Planes interpolated between sparse points, and the planar prior of evenly coloured regions."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor

import cv2
import numpy as np
from numpy.typing import NDArray

from mvs_backends.patchmatch.geometry import LevelCamera, warp
from mvs_backends.patchmatch.planes.kernels import (
    FIT_SIZE,
    MAX_ERROR_PX,
    MAX_PLANES,
    MIN_POINTS,
    find_planes,
    paint_planes,
)

# Grey values per pixel, of 255.
_MAX_GRADIENT = 3.0
_MIN_REGION_PX = 80
_MAX_POINTS_OF_VIEW = 500_000
# Of a point that lies on a plane: where parallax is little, almost anything lies on one to a few pixels.
_MAX_RELATIVE_ERROR = 0.025


def interpolated_planes(
    points: NDArray[np.float32], inverse_depths: NDArray[np.float32], width: int, height: int
) -> NDArray[np.float32]:
    """Planes through the Delaunay triangles of points in the image.

    Args:
        points: (P, 2) pixels, centres at whole numbers.
        inverse_depths: (P,)
        width: of the image.
        height: of the image.

    Returns:
        (height, width, 3) inverse depth and its slopes along x and y; 0 outside the points' convex hull.
    """
    planes = np.zeros((height, width, 3), np.float32)
    cells = _cells(points)
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
    return planes


def even_regions(grey: NDArray[np.uint8]) -> tuple[NDArray[np.int32], list[tuple[slice, slice]]]:
    """Connected pieces of the image without edges.

    Returns:
        (H, W) number of the region that a pixel belongs to, or -1, and the box around each region.
    """
    smooth = cv2.GaussianBlur(grey, (0, 0), 0.8).astype(np.float32)
    gradient = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)) / 8
    even = (gradient < _MAX_GRADIENT).astype(np.uint8)
    count, label, statistics, _ = cv2.connectedComponentsWithStats(even, connectivity=4)
    large = np.flatnonzero(statistics[1:, cv2.CC_STAT_AREA] >= _MIN_REGION_PX) + 1
    number = np.full(count, -1, np.int32)
    number[large] = np.arange(len(large))
    boxes = [(slice(top, top + height), slice(left, left + width)) for left, top, width, height, _ in statistics[large]]
    return number[label], boxes


def points_in_image(
    plane: NDArray[np.float32], chosen: NDArray[np.bool_], source: LevelCamera, camera: LevelCamera
) -> NDArray[np.float32]:
    """Points of a source view's map in the image of another, or of the same at another size.

    Args:
        plane: (H, W, 3) the source view's plane hypotheses.
        chosen: (H, W) pixels that are wanted; of very many, evenly spread ones.
        source: the source view.
        camera: the other.

    Returns:
        (P, 3) columns, rows and inverse depths of the points that project into the image.
    """
    rows, columns = np.nonzero(chosen)
    step = 1 + len(rows) // _MAX_POINTS_OF_VIEW
    rows, columns = rows[::step], columns[::step]
    w = plane[rows, columns, 0]
    to_image = warp(camera, source)
    pixels = np.stack([columns, rows, np.ones_like(rows)], axis=1).astype(np.float32)
    x, y, z = (pixels @ to_image[:9].reshape(3, 3).T + np.outer(w, to_image[9:])).T
    before = z > 0
    points = np.stack([x[before], y[before], w[before]], axis=1) / z[before, None]
    cells = _cells(points)
    inside: NDArray[np.float32] = points[np.all((cells >= 0) & (cells < [camera.width, camera.height]), axis=1)]
    return inside


def _cells(points: NDArray[np.float32] | NDArray[np.float64]) -> NDArray[np.int64]:
    """(P, 2) column and row of the pixel that each point lies in."""
    return np.floor(points[:, :2].astype(np.float64) + 0.5).astype(np.int64)


def region_planes(
    regions: NDArray[np.int32],
    boxes: Sequence[tuple[slice, slice]],
    points: NDArray[np.float32],
    rate: NDArray[np.float32],
    executor: Executor,
) -> NDArray[np.float32]:
    """Planes of evenly coloured regions, from the credible points of this view and others.

    ACMP (Xu & Tao 2020) takes the triangles between credible pixels for planes. Those are as steep as two neighbours'
    errors make them, and span what doesn't belong together; here each region gets the planes that most of its points
    agree on, found by random sampling, as TAPA-MVS (Romanoni & Matteucci 2019) does for superpixels. A plane reaches as
    far as its own points determine it. As views share their points, their planes agree.

    Args:
        regions: (H, W) and
        boxes: as `even_regions` returns them.
        points: (P, 3) columns, rows and inverse depths of points in the image, within half a pixel of its borders.
        rate: (P,) pixels in a source view per unit of inverse depth.
        executor: runs regions side by side.

    Returns:
        (H, W, 3) inverse depth and its slopes along x and y; 0 where no plane is known.
    """
    planes = np.zeros((*regions.shape, 3), np.float32)
    columns, rows = _cells(points).T
    region_of_point = regions[rows, columns]
    order = np.argsort(region_of_point, kind="stable")
    starts = np.searchsorted(region_of_point[order], np.arange(len(boxes) + 1))

    def fit(region: int) -> None:
        box, own = boxes[region], order[starts[region] : starts[region + 1]]
        x, y, w = (points[own] - np.array([box[1].start, box[0].start, 0])).T
        px_per_w = np.maximum(rate[own], MAX_ERROR_PX / (_MAX_RELATIVE_ERROR * w))
        _fit_region(regions[box], region, np.stack([x, y, w, px_per_w], axis=1), planes[box])

    for _ in executor.map(fit, np.flatnonzero(np.diff(starts) >= MIN_POINTS).tolist()):
        pass
    return planes


def _fit_region(
    regions: NDArray[np.int32], region: int, points: NDArray[np.float64], planes: NDArray[np.float32]
) -> None:
    """Write the planes of one region; where it has several, each pixel's is that of the nearest point."""
    fits, owner = np.zeros((MAX_PLANES, FIT_SIZE)), np.empty(len(points), np.int8)
    left, inliers = np.empty((2, len(points)), np.int64)
    count = find_planes(points, region, left, inliers, fits, owner)
    if count == 0:
        return
    nearest = np.zeros(regions.shape, np.int64)
    if count > 1:
        columns, rows = _cells(points).T
        away = np.ones((count, *regions.shape), np.uint8)
        on_plane = owner >= 0
        away[owner[on_plane], rows[on_plane], columns[on_plane]] = 0
        nearest = np.argmin([cv2.distanceTransform(mask, cv2.DIST_L2, 3) for mask in away], axis=0)
    paint_planes(regions, region, nearest, fits, planes)
