"""Blocks of the grid with their keypoints, heights and images ([O] section 3)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from app.clustering.grid import Cell, CellIndex, GroundGrid
from app.clustering.kernels import cameras_with_a_view
from app.clustering.options import ClusteringOptions
from app.clustering.samples import height_range, sample_axes
from app.scene.posed_scene import PosedScene
from fusion.region import ground_cells


@dataclass(frozen=True, kw_only=True)
class Block:
    """One or more cells with what belongs to them."""

    cells: tuple[Cell, ...]
    """Sorted."""
    num_keypoints: int
    """In the cells, without the overlap."""
    z_range_m: tuple[float, float]
    image_rows: NDArray[np.int64]
    """Ascending."""


class DropReason(StrEnum):
    """Why a cell isn't reconstructed."""

    FEW_KEYPOINTS = "fewer keypoints than min_keypoints_per_block"
    NO_IMAGE = "no image sees it from within max_camera_distance_m"


@dataclass(frozen=True, kw_only=True)
class DroppedBlock:
    """A cell with keypoints that isn't reconstructed."""

    cell: Cell
    num_keypoints: int
    reason: DropReason


@dataclass(frozen=True, kw_only=True)
class Blocks:
    """All cells with keypoints in reach of a camera."""

    grid: GroundGrid
    kept: list[Block]
    dropped: list[DroppedBlock]
    num_far_keypoints: int
    """Beyond `max_camera_distance_m` of the range of the cameras: no block there could have an image."""


def associate(scene: PosedScene, options: ClusteringOptions) -> Blocks:
    """Assign keypoints and images to blocks.

    Args:
        scene: The posed model.
        options: With lengths in the model's units.
    """
    centers = scene.centers_in_world
    near, grid = _grid(scene.points_in_world, centers, options)
    keypoints = scene.points_in_world[near]
    num_far = len(near) - len(keypoints)
    if len(keypoints) == 0:
        return Blocks(grid=grid, kept=[], dropped=[], num_far_keypoints=num_far)

    keypoint_cells = grid.cells_of(keypoints)
    keypoint_index, camera_index = CellIndex(keypoint_cells), CellIndex(grid.cells_of(centers))
    image_from_world, sizes_px = scene.image_from_world, scene.image_sizes_px
    reach = tuple(math.ceil(options.max_camera_distance_m / side + 0.5) for side in options.block_size_m)
    kept, dropped = [], []
    for i, j, count in zip(*_count_cells(keypoint_cells), strict=True):
        cell = (int(i), int(j))
        if count < options.min_keypoints_per_block:
            dropped.append(DroppedBlock(cell=cell, num_keypoints=int(count), reason=DropReason.FEW_KEYPOINTS))
            continue
        around = keypoints[keypoint_index.rows_around(cell, (1, 1))]
        z_range = height_range(
            around[:, 2],
            centers[camera_index.rows_around(cell, (1, 1)), 2],
            quantiles=options.height_quantiles,
            margin=options.height_margin_m,
            camera_height=options.camera_height_m,
        )
        box = grid.region((cell,), z_range).padded_boxes()[0]
        box[:, 2] = z_range
        inside = np.all((around[:, :2] >= box[0, :2]) & (around[:, :2] <= box[1, :2]), axis=1)
        candidates = camera_index.rows_around(cell, (reach[0], reach[1]))
        distances = np.hypot(*(centers[candidates, :2] - grid.center_of(cell)).T)
        candidates = candidates[distances <= options.max_camera_distance_m]
        x, y, z = sample_axes(box, options.sample_spacing_m)
        with_view = cameras_with_a_view(around[inside], x, y, z, image_from_world[candidates], sizes_px[candidates])
        if not with_view.any():
            dropped.append(DroppedBlock(cell=cell, num_keypoints=int(count), reason=DropReason.NO_IMAGE))
            continue
        kept.append(Block(cells=(cell,), num_keypoints=int(count), z_range_m=z_range, image_rows=candidates[with_view]))
    return Blocks(grid=grid, kept=kept, dropped=dropped, num_far_keypoints=num_far)


def _grid(
    points: NDArray[np.float64], centers: NDArray[np.float64], options: ClusteringOptions
) -> tuple[NDArray[np.bool_], GroundGrid]:
    """The keypoints in the robust range, and the grid over them.

    The range is the cells that a block in reach of some camera could have, so that far outliers neither decide where
    the grid begins nor how large it is.
    """
    size = np.array(options.block_size_m)
    low = np.floor((centers[:, :2].min(axis=0) - options.max_camera_distance_m) / size) - 1
    high = np.floor((centers[:, :2].max(axis=0) + options.max_camera_distance_m) / size) + 1
    cells = ground_cells(points, (0.0, 0.0), options.block_size_m)
    near: NDArray[np.bool_] = np.all((cells >= low) & (cells <= high), axis=1)
    origin = (cells[near].min(axis=0) if near.any() else low) * size
    return near, GroundGrid(
        origin_m=(float(origin[0]), float(origin[1])),
        block_size_m=options.block_size_m,
        overlap_m=options.overlap_m,
        sample_spacing_m=options.sample_spacing_m,
    )


def _count_cells(cells: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """i, j and number of rows of each distinct cell, in ascending order."""
    distinct, counts = np.unique(cells, axis=0, return_counts=True)
    return distinct[:, 0], distinct[:, 1], counts
