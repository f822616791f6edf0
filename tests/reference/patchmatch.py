"""Slow plain twins of the kernels of the PatchMatch back-end, written with points, normals and homographies."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
MASK = 2**64 - 1


@dataclass
class Camera:
    """A pinhole whose pixel centres are at whole numbers."""

    calibration: Array
    pose: Array
    """(3, 4) cam_from_world."""
    grey: NDArray[np.uint8]


def point_on_plane(camera: Camera, x: float, y: float, plane: Array, at: tuple[float, float]) -> Array:
    """World point where the ray of pixel (x, y) meets the plane (w, a, b) of pixel `at`."""
    depth = 1 / (plane[0] + plane[1] * (x - at[0]) + plane[2] * (y - at[1]))
    in_camera = np.linalg.inv(camera.calibration) @ [x, y, 1.0] * depth
    return camera.pose[:, :3].T @ (in_camera - camera.pose[:, 3])


def project(camera: Camera, point: Array) -> tuple[float, float, float]:
    """Pixel and depth of a world point."""
    in_camera = camera.pose[:, :3] @ point + camera.pose[:, 3]
    pixel = camera.calibration @ in_camera
    return pixel[0] / pixel[2], pixel[1] / pixel[2], in_camera[2]


def normal_of(camera: Camera, x: float, y: float, plane: Array) -> Array:
    """Unit normal towards the camera, from three points of the plane."""
    first, right, below = (
        camera.pose[:, :3] @ point_on_plane(camera, x + dx, y + dy, plane, (x, y)) + camera.pose[:, 3]
        for dx, dy in ((0, 0), (1, 0), (0, 1))
    )
    normal = np.cross(right - first, below - first)
    normal /= np.linalg.norm(normal)
    return -normal if normal @ first > 0 else normal


def interpolate(grey: NDArray[np.uint8], x: float, y: float) -> float:
    """Bilinear grey value."""
    x0, y0 = int(x), int(y)
    fx, fy = x - x0, y - y0
    g = grey[y0 : y0 + 2, x0 : x0 + 2].astype(np.float64)
    return float((g[0, 0] * (1 - fx) + g[0, 1] * fx) * (1 - fy) + (g[1, 0] * (1 - fx) + g[1, 1] * fx) * fy)


def window_offsets() -> list[tuple[int, int]]:
    """Every second pixel of 11 x 11, without the corners."""
    return [(x, y) for y in range(-5, 6, 2) for x in range(-5, 6, 2) if abs(x) + abs(y) < 10]


def patch_weights(grey: NDArray[np.uint8], x: int, y: int, sigma_space: float, sigma_grey: float) -> Array:
    """Normalised bilateral weights of the window; 0 outside the image."""
    weights = []
    for dx, dy in window_offsets():
        if not (0 <= x + dx < grey.shape[1] and 0 <= y + dy < grey.shape[0]):
            weights.append(0.0)
            continue
        step = float(grey[y + dy, x + dx]) - float(grey[y, x])
        alike = max(math.exp(-(step**2) / (2 * sigma_grey**2)), 1e-9)
        weights.append(math.exp(-(dx * dx + dy * dy) / (2 * sigma_space**2)) * alike)
    return np.array(weights) / sum(weights)


def patch_cost(
    reference: Camera, source: Camera, x: int, y: int, plane: Array, sigma_space: float, sigma_grey: float
) -> float:
    """1 - bilateral NCC of a patch that lies wholly in the source image."""
    weights = patch_weights(reference.grey, x, y, sigma_space, sigma_grey)
    ours, theirs = [], []
    for (dx, dy), weight in zip(window_offsets(), weights, strict=True):
        ours.append(float(reference.grey[y + dy, x + dx]) if weight > 0 else 0.0)
        point = point_on_plane(reference, x + dx, y + dy, plane, (x, y))
        u, v, _ = project(source, point)
        height, width = source.grey.shape
        theirs.append(interpolate(source.grey, min(max(u, 0), width - 1.01), min(max(v, 0), height - 1.01)))
    a, b = np.array(ours) - weights @ ours, np.array(theirs) - weights @ theirs
    ncc = (weights @ (a * b)) / math.sqrt((weights @ (a * a)) * (weights @ (b * b)))
    return min(max(1 - ncc, 0.0), 2.0)


def reprojection_error(
    reference: Camera, source: Camera, source_plane: Array, x: float, y: float, w: float, cap: float
) -> float:
    """Capped forward-backward error e as e^2 / (1 + e); `source_plane` (H, W, 3) is the source's map."""
    worst = cap**2 / (1 + cap)
    u, v, depth = project(source, point_on_plane(reference, x, y, np.array([w, 0, 0]), (x, y)))
    column, row = math.floor(u + 0.5), math.floor(v + 0.5)
    height, width = source_plane.shape[:2]
    if depth <= 0 or not (0 <= column < width and 0 <= row < height) or source_plane[row, column, 0] <= 0:
        return worst
    back = point_on_plane(source, u, v, source_plane[row, column], (column, row))
    bx, by, depth = project(reference, back)
    error = min(math.hypot(bx - x, by - y), cap)
    return worst if depth <= 0 else error**2 / (1 + error)


def triangulation_factor(reference: Camera, source: Camera, x: int, y: int, w: float, min_angle: float) -> float:
    """min(1, (sin angle / min_angle)^2) between the rays to the point, a thousandth added."""
    point = point_on_plane(reference, x, y, np.array([w, 0, 0]), (x, y))
    rays = [point + camera.pose[:, :3].T @ camera.pose[:, 3] for camera in (reference, source)]
    sine = np.linalg.norm(np.cross(*rays)) / np.prod([np.linalg.norm(ray) for ray in rays])
    return min(sine**2 / min_angle**2 + 1e-3, 1.0)


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
    reference: Camera, sources: list[Camera], maps: Array, x: int, y: int, plane: Array, max_cost: float, sigmas: Array
) -> int:
    """Source views where the patch matches, matches nowhere within 2 pixels, and whose own map agrees to a pixel."""
    count = 0
    for source, its_map in zip(sources, maps, strict=True):
        step = np.array([2 / px_per_inverse_depth(reference, source, x, y, plane[0]), 0, 0])
        cost, *others = (
            patch_cost(reference, source, x, y, plane + shift, *sigmas) for shift in (0 * step, step, -step)
        )
        near = reprojection_error(reference, source, its_map, x, y, plane[0], 2.0) <= 0.5
        count += near and cost <= max_cost and min(others) > cost + 0.1
    return count
