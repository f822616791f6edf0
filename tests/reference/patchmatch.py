"""Slow plain twins of the kernels of the PatchMatch back-end, written with points, normals and homographies."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
MASK = 2**64 - 1
WINDOW = np.array([(x, y) for y in range(-5, 6, 2) for x in range(-5, 6, 2) if abs(x) + abs(y) < 10])
"""(32, 2) x, y: every second pixel of 11 x 11, without the corners."""


@dataclass
class Camera:
    """A pinhole whose pixel centres are at whole numbers."""

    calibration: Array
    pose: Array
    """(3, 4) cam_from_world."""
    grey: NDArray[np.uint8]


def point_on_plane(camera: Camera, x: Any, y: Any, plane: Array, at: tuple[float, float]) -> Array:
    """(..., 3) world points where the rays of pixels (x, y) meet the plane (w, a, b) of pixel `at`."""
    depth = 1 / (plane[0] + plane[1] * (x - at[0]) + plane[2] * (y - at[1]))
    rays = np.stack([x, y, np.ones_like(depth)], axis=-1) @ np.linalg.inv(camera.calibration).T
    return (rays * np.asarray(depth)[..., None] - camera.pose[:, 3]) @ camera.pose[:, :3]


def project(camera: Camera, point: Array) -> tuple[Any, Any, Any]:
    """Pixels and depths of (..., 3) world points."""
    in_camera = point @ camera.pose[:, :3].T + camera.pose[:, 3]
    pixel = in_camera @ camera.calibration.T
    return pixel[..., 0] / pixel[..., 2], pixel[..., 1] / pixel[..., 2], in_camera[..., 2]


def normal_of(camera: Camera, x: float, y: float, plane: Array) -> Array:
    """Unit normal towards the camera, from three points of the plane."""
    first, right, below = (
        camera.pose[:, :3] @ point_on_plane(camera, x + dx, y + dy, plane, (x, y)) + camera.pose[:, 3]
        for dx, dy in ((0, 0), (1, 0), (0, 1))
    )
    normal = np.cross(right - first, below - first)
    normal /= np.linalg.norm(normal)
    return -normal if normal @ first > 0 else normal


def packed_neighbours(grey: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """(H * W,) each pixel, the one on its right and the two below, from the lowest byte up; borders repeat."""
    padded = np.pad(grey, ((0, 1), (0, 1)), mode="edge").astype(np.uint32)
    return (padded[:-1, :-1] + (padded[:-1, 1:] << 8) + (padded[1:, :-1] << 16) + (padded[1:, 1:] << 24)).ravel()


def interpolate(grey: NDArray[np.uint8], x: Array, y: Array) -> Array:
    """Bilinear grey values."""
    x0, y0 = x.astype(int), y.astype(int)
    fx, fy = x - x0, y - y0
    g = grey.astype(np.float64)
    above = g[y0, x0] * (1 - fx) + g[y0, x0 + 1] * fx
    below = g[y0 + 1, x0] * (1 - fx) + g[y0 + 1, x0 + 1] * fx
    return above * (1 - fy) + below * fy


def patch_weights(grey: NDArray[np.uint8], x: int, y: int, sigmas: tuple[float, float]) -> Array:
    """(32,) normalised bilateral weights of the window by distance and grey value; 0 outside the image."""
    columns, rows = np.array([x, y])[:, None] + WINDOW.T
    inside = (columns >= 0) & (columns < grey.shape[1]) & (rows >= 0) & (rows < grey.shape[0])
    near = np.exp(-np.sum(WINDOW**2, axis=1) / (2 * sigmas[0] ** 2))
    alike = np.exp(-((patch_values(grey, x, y) - grey[y, x]) ** 2) / (2 * sigmas[1] ** 2))
    weights = np.where(inside, near * np.maximum(alike, 1e-9), 0.0)
    return weights / weights.sum()


def patch_values(grey: NDArray[np.uint8], x: int, y: int) -> Array:
    """(32,) grey values of the window; anything outside the image."""
    columns, rows = np.clip(WINDOW + [x, y], 0, [grey.shape[1] - 1, grey.shape[0] - 1]).T
    return grey[rows, columns].astype(np.float64)


def patch_variance(grey: NDArray[np.uint8], x: int, y: int, sigmas: tuple[float, float]) -> float:
    """Weighted variance of the window's grey values."""
    weights, values = patch_weights(grey, x, y, sigmas), patch_values(grey, x, y)
    return float(weights @ (values - weights @ values) ** 2)


def patch_cost(reference: Camera, source: Camera, x: int, y: int, plane: Array, sigmas: tuple[float, float]) -> float:
    """1 - bilateral NCC; 2 where the patch reaches behind the source view or out of its image, or is bare there."""
    step = 1e-4
    corners = np.array([(-7, -7), (-7, 7), (7, -7), (7, 7)])
    steps = step * np.array([(0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)])
    dx, dy = np.concatenate([WINDOW, corners, steps]).T
    u, v, depth = project(source, point_on_plane(reference, x + dx, y + dy, plane, (x, y)))
    if np.any((depth * (plane[0] + plane[1] * dx + plane[2] * dy))[32:36] <= 0):
        return 2.0
    limits = np.array([source.grey.shape[1], source.grey.shape[0]]) - 1.01
    middle, left, right, above, below = np.stack([u, v], axis=1)[36:]
    reach = 3 * (np.abs(right - left) + np.abs(below - above)) / (2 * step)
    if np.any((middle < reach) | (middle > limits - reach)):
        return 2.0
    theirs = interpolate(source.grey, np.clip(u[:32], 0, limits[0]), np.clip(v[:32], 0, limits[1]))
    weights, ours = patch_weights(reference.grey, x, y, sigmas), patch_values(reference.grey, x, y)
    a, b = ours - weights @ ours, theirs - weights @ theirs
    if weights @ (b * b) < 0.5:
        return 2.0
    ncc = (weights @ (a * b)) / math.sqrt((weights @ (a * a)) * (weights @ (b * b)))
    return float(min(max(1 - ncc, 0.0), 2.0))


def reprojection_error(
    reference: Camera, source: Camera, source_plane: Array, x: float, y: float, w: float, cap: float
) -> float:
    """Capped forward-backward error; `source_plane` (H, W, 3) is the source's map."""
    u, v, depth = project(source, point_on_plane(reference, x, y, np.array([w, 0, 0]), (x, y)))
    column, row = math.floor(u + 0.5), math.floor(v + 0.5)
    height, width = source_plane.shape[:2]
    if depth <= 0 or not (0 <= column < width and 0 <= row < height) or source_plane[row, column, 0] <= 0:
        return cap
    back = point_on_plane(source, u, v, source_plane[row, column], (column, row))
    bx, by, depth = project(reference, back)
    return cap if depth <= 0 else min(math.hypot(bx - x, by - y), cap)


def smoothed(plane: Array, rate: Array, radius: int) -> Array:
    """Each plane averaged with those of the neighbourhood that agree; `rate` (H, W) pixels per inverse depth."""
    result = plane.copy()
    height, width = plane.shape[:2]
    for y in range(height):
        for x in range(width):
            if plane[y, x, 0] <= 0:
                continue
            total, mean = 0.0, np.zeros(3)
            for ny in range(max(0, y - radius), min(height, y + radius + 1)):
                for nx in range(max(0, x - radius), min(width, x + radius + 1)):
                    w, a, b = plane[ny, nx]
                    if w <= 0:
                        continue
                    here = np.array([w + a * (x - nx) + b * (y - ny), a, b])
                    weight = (1 + 16 * ((here[0] - plane[y, x, 0]) * rate[y, x]) ** 2) ** -2
                    total, mean = total + weight, mean + weight * here
            result[y, x] = mean / total
    return result


def upsampled(
    coarse: Array, cost: Array, coarse_grey: NDArray[np.uint8], grey: NDArray[np.uint8], limits: Array
) -> Array:
    """Per fine pixel the plane of the most similar of the 4 nearest coarse pixels, moved to it."""
    scale = np.array(coarse_grey.shape) / grey.shape
    result = np.zeros((*grey.shape, 3))
    for y, x in np.ndindex(grey.shape):
        low, high = limits[y, x]
        if high <= 0:
            continue
        cy, cx = (y + 0.5) * scale[0] - 0.5, (x + 0.5) * scale[1] - 0.5
        best = math.inf
        result[y, x, 0] = (low + high) / 2
        for ny in (math.floor(cy), math.floor(cy) + 1):
            for nx in (math.floor(cx), math.floor(cx) + 1):
                ny_, nx_ = min(max(ny, 0), coarse.shape[0] - 1), min(max(nx, 0), coarse.shape[1] - 1)
                w, a, b = coarse[ny_, nx_]
                if w <= 0:
                    continue
                oy, ox = cy - ny_, cx - nx_
                step = abs(int(coarse_grey[ny_, nx_]) - int(grey[y, x]))
                badness = step / 10 + 0.5 * (ox**2 + oy**2) + cost[ny_, nx_]
                if badness < best:
                    best = badness
                    moved = min(max(w + a * ox + b * oy, low), high)
                    result[y, x] = moved, a * scale[1], b * scale[0]
    return result


def random_bits(state: int) -> int:
    """The finaliser of splitmix64."""
    state = ((state ^ (state >> 30)) * 0xBF58476D1CE4E5B9) & MASK
    state = ((state ^ (state >> 27)) * 0x94D049BB133111EB) & MASK
    return state ^ (state >> 31)


def area_offsets() -> list[list[tuple[int, int]]]:
    """The 8 areas of adaptive checkerboard sampling: up, down, left, right; near V shapes, then far strips."""
    near_up = [(0, -1), (-1, -2), (1, -2), (-2, -3), (2, -3), (-3, -4), (3, -4)]
    far_up = [(0, -3 - 2 * i) for i in range(11)]
    turned = []
    for up in (near_up, far_up):
        turned += [up, [(x, -y) for x, y in up], [(y, x) for x, y in up], [(-y, x) for x, y in up]]
    return turned


def candidate_planes(plane: Array, cost: Array, limits: Array, x: int, y: int) -> Array:
    """(C, 3) the pixel's own plane, then the best of each area, moved to the pixel; those out of range left out."""
    height, width = cost.shape
    found = [plane[y, x]]
    for area in area_offsets():
        inside = [(x + dx, y + dy) for dx, dy in area if 0 <= x + dx < width and 0 <= y + dy < height]
        if not inside:
            continue
        nx, ny = min(inside, key=lambda p: cost[p[1], p[0]])
        w, a, b = plane[ny, nx]
        moved = w + a * (x - nx) + b * (y - ny)
        if limits[y, x, 0] <= moved <= limits[y, x, 1]:
            found.append(np.array([moved, a, b]))
    return np.array(found)


def view_weights(costs: Array, previous: int, iteration: int) -> Array:
    """ACMM's view weights from (C, N) costs of hypotheses in views, before the triangulation angle."""
    good_cost = 0.8 * math.exp(-(iteration**2) / 90)
    weights = np.zeros(costs.shape[1])
    for j, column in enumerate(costs.T):
        good = column[column < good_cost]
        if len(good) > 2 and np.sum(column > 1.2) < 3:
            weights[j] = np.mean(np.exp(-(good**2) / (2 * 0.3**2))) * (2 if j == previous else 1)
        elif j == previous:
            weights[j] = 0.2
    return weights


def px_per_inverse_depth(reference: Camera, source: Camera, x: int, y: int, w: float) -> float:
    """How far the pixel's projection into the source view moves per unit of inverse depth."""
    step = 1e-5
    (x1, y1, _), (x2, y2, _) = (
        project(source, point_on_plane(reference, x, y, np.array([v, 0, 0]), (x, y))) for v in (w - step, w + step)
    )
    return math.hypot(x2 - x1, y2 - y1) / (2 * step)


def num_confirming(
    reference: Camera, sources: list[Camera], maps: Array, x: int, y: int, plane: Array, max_cost: float, sigmas: Any
) -> int:
    """Source views where the patch matches, matches nowhere within 2 pixels, and whose own map agrees to a pixel."""
    count = 0
    for source, its_map in zip(sources, maps, strict=True):
        step = np.array([2 / px_per_inverse_depth(reference, source, x, y, plane[0]), 0, 0])
        cost, *others = (
            patch_cost(reference, source, x, y, plane + shift, sigmas) for shift in (0 * step, step, -step)
        )
        near = reprojection_error(reference, source, its_map, x, y, plane[0], 2.0) <= 0.5
        count += near and cost <= max_cost and min(others) > cost + 0.1
    return count


def averaged(reference: Camera, sources: list[Camera], maps: Array, plane: Array) -> Array:
    """(H, W) inverse depths, each the mean of its own and those where its ray meets the sources' planes near by."""
    result = plane[..., 0].copy()
    center = -reference.pose[:, :3].T @ reference.pose[:, 3]
    for y, x in np.argwhere(plane[..., 0] > 0):
        w = plane[y, x, 0]
        here = point_on_plane(reference, float(x), float(y), np.array([w, 0, 0]), (x, y))
        found, weights = [w], [1.0]
        for source, its_map in zip(sources, maps, strict=True):
            u, v, depth = project(source, here)
            column, row = math.floor(u + 0.5), math.floor(v + 0.5)
            inside = depth > 0 and 0 <= row < its_map.shape[0] and 0 <= column < its_map.shape[1]
            if not inside or its_map[row, column, 0] <= 0:
                continue
            corners = [
                point_on_plane(source, column + dx, row + dy, its_map[row, column], (column, row))
                for dx, dy in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))
            ]
            normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
            met = center + (here - center) * (normal @ (corners[0] - center)) / (normal @ (here - center))
            there = 1 / (reference.pose[2, :3] @ met + reference.pose[2, 3])
            half_px = 0.5 / px_per_inverse_depth(reference, source, x, y, w)
            bound = max(0.01 * w, min(half_px, 0.03 * w))
            if abs(there - w) < bound:
                found.append(there)
                weights.append((1 - ((there - w) / bound) ** 2) ** 2 / (w * depth) ** 2)
        result[y, x] = np.average(found, weights=weights)
    return result
