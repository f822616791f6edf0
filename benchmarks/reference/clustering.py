"""View clustering as [O] section 3 describes it: every point of a block is projected into every camera near by.

Where [O] is silent, the decisions are those of the program (its options say why), reached by other code.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.clustering.options import ClusteringOptions
from app.scene.posed_scene import PosedScene

Cell = tuple[int, int]
Box = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Lower and upper corner."""


@dataclass(frozen=True, kw_only=True)
class PlainCluster:
    """Cells of the ground and the images that see them."""

    cells: tuple[Cell, ...]
    """Sorted; cell (i, j) begins at i and j times the block size."""
    z_range: tuple[float, float]
    images: frozenset[int]
    """Rows of the scene."""


def plain_clusters(scene: PosedScene, options: ClusteringOptions) -> list[PlainCluster]:
    """All clusters, in the order of their first cells."""
    blocks = []
    for cell in _occupied_cells(scene, options):
        z_range = _z_range(scene, cell, options)
        points = block_points(scene, cell, z_range, options)
        images = [image for image in _images_near(scene, cell, options) if sees(scene, image, points).any()]
        if images:
            blocks.append(PlainCluster(cells=(cell,), z_range=z_range, images=frozenset(images)))
    return _merge(blocks, options.min_cameras_per_cluster)


def sees(scene: PosedScene, image: int, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(n,) which of (n, 3) points an image has in front of it and inside its rectangle."""
    rotation, translation = scene.cam_from_world[image, :, :3], scene.cam_from_world[image, :, 3]
    fx, fy, cx, cy = scene.camera_params_px[scene.camera_index[image]]
    width, height = scene.camera_sizes_px[scene.camera_index[image]]
    x, y, z = (points @ rotation.T + translation).T
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = fx * x / z + cx, fy * y / z + cy
    return (z > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height)


def block_points(
    scene: PosedScene, cell: Cell, z_range: tuple[float, float], options: ClusteringOptions
) -> NDArray[np.float64]:
    """(n, 3) keypoints and uniform samples in the padded bounds of a cell."""
    low, high = padded_bounds(cell, options)
    return np.concatenate([scene.points_in_world[inside(scene, low, high)], samples(low, high, z_range, options)])


def inside(scene: PosedScene, low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(P,) which keypoints lie between two positions on the ground, heights aside."""
    ground = scene.points_in_world[:, :2]
    within: NDArray[np.bool_] = np.all((ground >= low) & (ground <= high), axis=1)
    return within


def padded_bounds(cell: Cell, options: ClusteringOptions) -> Box:
    """A cell with the overlap d_overlap around it."""
    size = np.array(options.block_size_m)
    return np.array(cell) * size - options.overlap_m, (np.array(cell) + 1) * size + options.overlap_m


def samples(
    low: NDArray[np.float64], high: NDArray[np.float64], z_range: tuple[float, float], options: ClusteringOptions
) -> NDArray[np.float64]:
    """(n, 3) points with spacing r, which divides each side evenly, in the middle of their share."""
    axes = []
    for start, end in ((low[0], high[0]), (low[1], high[1]), z_range):
        count = max(1, round((end - start) / options.sample_spacing_m))
        axes.append([start + (end - start) * (k + 0.5) / count for k in range(count)])
    return np.array(list(itertools.product(*axes)))


def _occupied_cells(scene: PosedScene, options: ClusteringOptions) -> list[Cell]:
    """Cells with enough keypoints, in reach of the range of the cameras."""
    size = np.array(options.block_size_m)
    centers = scene.centers_in_world[:, :2]
    low = np.floor((centers.min(axis=0) - options.max_camera_distance_m) / size) - 1
    high = np.floor((centers.max(axis=0) + options.max_camera_distance_m) / size) + 1
    counts: dict[Cell, int] = {}
    for i, j in np.floor(scene.points_in_world[:, :2] / size).tolist():
        if low[0] <= i <= high[0] and low[1] <= j <= high[1]:
            counts[int(i), int(j)] = counts.get((int(i), int(j)), 0) + 1
    return sorted(cell for cell, count in counts.items() if count >= options.min_keypoints_per_block)


def _z_range(scene: PosedScene, cell: Cell, options: ClusteringOptions) -> tuple[float, float]:
    """Robust heights of the keypoints in a cell and around it, down to the road under the cameras there."""
    size = np.array(options.block_size_m)
    low, high = (np.array(cell) - 1) * size, (np.array(cell) + 2) * size
    bottom, top = np.quantile(scene.points_in_world[inside(scene, low, high), 2], options.height_quantiles)
    centers = scene.centers_in_world
    here = np.all((centers[:, :2] >= low) & (centers[:, :2] <= high), axis=1)
    if here.any():
        bottom = min(bottom, np.median(centers[here, 2]) - options.camera_height_m)
    return float(bottom - options.height_margin_m), float(top + options.height_margin_m)


def _images_near(scene: PosedScene, cell: Cell, options: ClusteringOptions) -> list[int]:
    center = (np.array(cell) + 0.5) * options.block_size_m
    distances = np.hypot(*(scene.centers_in_world[:, :2] - center).T)
    return np.flatnonzero(distances <= options.max_camera_distance_m).tolist()


def _merge(blocks: list[PlainCluster], min_images: int) -> list[PlainCluster]:
    """Merge small clusters, the smallest first, with the neighbour that shares the most images."""
    while True:
        small = [block for block in blocks if len(block.images) < min_images and _neighbours(block, blocks)]
        if not small:
            return sorted(blocks, key=lambda block: block.cells)
        block = min(small, key=lambda b: (len(b.images), b.cells[0]))
        other = min(_neighbours(block, blocks), key=lambda b: (-len(b.images & block.images), b.cells[0]))
        merged = PlainCluster(
            cells=tuple(sorted(block.cells + other.cells)),
            z_range=(min(block.z_range[0], other.z_range[0]), max(block.z_range[1], other.z_range[1])),
            images=block.images | other.images,
        )
        blocks = [b for b in blocks if b is not block and b is not other] + [merged]


def _neighbours(block: PlainCluster, blocks: list[PlainCluster]) -> list[PlainCluster]:
    """Those beside a cluster, or at its corners where none is beside it."""
    for offsets in (((-1, 0), (1, 0), (0, -1), (0, 1)), ((-1, -1), (-1, 1), (1, -1), (1, 1))):
        wanted = {(i + di, j + dj) for i, j in block.cells for di, dj in offsets}
        found = [other for other in blocks if other is not block and wanted.intersection(other.cells)]
        if found:
            return found
    return []
