"""Blocks of the grid with their keypoints, heights and images ([O] section 3)."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from app.clustering.grid import Cell, GroundGrid
from app.clustering.kernels import cameras_with_a_view
from app.clustering.options import BlockVisibility, ClusteringOptions
from app.clustering.samples import grid_points, height_range, sample_axes
from app.occlusion.solid_columns import solid_in_scene
from app.scene.kernels import frustum_bits
from app.scene.point_index import PointIndex
from app.scene.posed_scene import PosedScene
from fusion.region import ground_cells

_PIECE_POINTS = 1 << 20


@dataclass(frozen=True, kw_only=True)
class Block:
    """One or more cells with what belongs to them."""

    cells: tuple[Cell, ...]
    """Sorted."""
    num_keypoints: int
    """In the cells, without the overlap."""
    z_range_m: tuple[float, float]
    image_rows: NDArray[np.integer]
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


def associate(scene: PosedScene, options: ClusteringOptions, num_threads: int = 1) -> Blocks:
    """Assign keypoints and images to blocks.

    Args:
        scene: The posed model.
        options: With lengths in the model's units.
        num_threads: That look for what hides blocks from images; the result doesn't depend on it.
    """
    centers = scene.centers_in_world
    grid, cells, counts, num_far = _occupied_cells(scene.points_in_world, centers, options)
    finder = _BlockFinder(scene, options, grid, centers)
    wanted = map(tuple, cells.tolist()), counts.tolist()
    if options.visibility is BlockVisibility.OCCLUDED:
        with ThreadPoolExecutor(num_threads) as threads:
            found = list(threads.map(finder.find, *wanted))
    else:
        # Too quick for threads, which would wait for each other's Python.
        found = list(map(finder.find, *wanted))
    return Blocks(
        grid=grid,
        kept=[block for block in found if isinstance(block, Block)],
        dropped=[block for block in found if isinstance(block, DroppedBlock)],
        num_far_keypoints=num_far,
    )


class _BlockFinder:
    """Finds the images of cells."""

    def __init__(
        self, scene: PosedScene, options: ClusteringOptions, grid: GroundGrid, centers: NDArray[np.float64]
    ) -> None:
        self._scene, self._options, self._grid, self._centers = scene, options, grid, centers
        self._points, self._cameras = PointIndex(scene.points_in_world), PointIndex(centers)
        self._image_from_world, self._sizes_px = scene.image_from_world, scene.image_sizes_px

    def find(self, cell: Cell, num_keypoints: int) -> Block | DroppedBlock:
        """The block of a cell with so many keypoints, or why there is none."""
        options, centers = self._options, self._centers
        if num_keypoints < options.min_keypoints_per_block:
            return DroppedBlock(cell=cell, num_keypoints=num_keypoints, reason=DropReason.FEW_KEYPOINTS)
        center, size = self._grid.center_of(cell), np.array(options.block_size_m)
        around = self._scene.points_in_world[self._points.rows_between(center - 1.5 * size, center + 1.5 * size)]
        z_range = height_range(
            around[:, 2],
            centers[self._cameras.rows_between(center - 1.5 * size, center + 1.5 * size), 2],
            quantiles=options.height_quantiles,
            margin=options.height_margin_m,
            camera_height=options.camera_height_m,
        )
        box = self._grid.region((cell,), z_range).padded_boxes()[0]
        box[:, 2] = z_range
        x, y = around[:, 0], around[:, 1]
        inside = (x >= box[0, 0]) & (x <= box[1, 0]) & (y >= box[0, 1]) & (y <= box[1, 1])
        reach = options.max_camera_distance_m
        near = self._cameras.rows_between(center - reach, center + reach)
        near = near[np.hypot(*(centers[near, :2] - center).T) <= reach]
        xs, ys, zs = sample_axes(box, options.sample_spacing_m)
        rows = near[cameras_with_a_view(around[inside], xs, ys, zs, self._image_from_world[near], self._sizes_px[near])]
        if options.visibility is BlockVisibility.OCCLUDED and len(rows):
            rows = rows[self._have_a_free_view(rows, around[inside], grid_points((xs, ys, zs)))]
        if not len(rows):
            return DroppedBlock(cell=cell, num_keypoints=num_keypoints, reason=DropReason.NO_IMAGE)
        return Block(cells=(cell,), num_keypoints=num_keypoints, z_range_m=z_range, image_rows=rows.astype(np.int32))

    def _have_a_free_view(
        self, image_rows: NDArray[np.integer], keypoints: NDArray[np.float64], samples: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """(n,) which of n images see a keypoint, or a sample outside of what is solid, that nothing solid hides."""
        centers = self._centers[image_rows]
        ground = np.concatenate([samples, keypoints, centers])[:, :2]
        bounds = np.stack([ground.min(axis=0), ground.max(axis=0)])
        solid = solid_in_scene(
            self._scene,
            self._points.rows_between(*bounds),
            self._centers,
            bounds_m=bounds,
            column_m=self._options.sample_spacing_m,
        )
        places = np.concatenate([keypoints, samples[~solid.hold(samples)]])
        in_image = frustum_bits(
            np.ascontiguousarray(places.T), self._image_from_world[image_rows], self._sizes_px[image_rows]
        )
        return solid.leave_any(in_image, centers, places)


def _occupied_cells(
    points: NDArray[np.float64], centers: NDArray[np.float64], options: ClusteringOptions
) -> tuple[GroundGrid, NDArray[np.int64], NDArray[np.int64], int]:
    """The grid over the keypoints in the robust range, its (C, 2) cells with keypoints, their counts, and the rest.

    The range is the cells that a block in reach of some camera could have, so that far outliers neither decide where
    the grid begins nor how large it is.
    """
    size = np.array(options.block_size_m)
    low = np.floor((centers[:, :2].min(axis=0) - options.max_camera_distance_m) / size) - 1
    high = np.floor((centers[:, :2].max(axis=0) + options.max_camera_distance_m) / size) + 1
    num_near, first = 0, np.full(2, np.inf)
    for near in _near(points, low, high, options):
        num_near += len(near)
        first = np.minimum(first, ground_cells(near, (0.0, 0.0), options.block_size_m).min(axis=0, initial=np.inf))
    origin = (first if num_near else low) * size
    grid = GroundGrid(
        origin_m=(float(origin[0]), float(origin[1])),
        block_size_m=options.block_size_m,
        overlap_m=options.overlap_m,
        sample_spacing_m=options.sample_spacing_m,
    )
    runs = [_runs(grid.cells_of(near)) for near in _near(points, low, high, options)]
    run_cells = np.concatenate([cells for cells, _ in runs] or [np.empty((0, 2), dtype=np.int64)])
    cells, slot = np.unique(run_cells, axis=0, return_inverse=True)
    counts = np.zeros(len(cells), dtype=np.int64)
    np.add.at(counts, slot.reshape(-1), np.concatenate([lengths for _, lengths in runs] or [counts]))
    return grid, cells, counts, len(points) - num_near


def _runs(cells: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The cells (n, 2) without repetitions in a row, and how long each run was."""
    starts = np.flatnonzero(
        np.append(True, (cells[1:, 0] != cells[:-1, 0]) | (cells[1:, 1] != cells[:-1, 1]))[: len(cells)]
    )
    return cells[starts], np.diff(np.append(starts, len(cells)))


def _near(
    points: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64], options: ClusteringOptions
) -> Iterator[NDArray[np.float64]]:
    """The points in a range of cells, piece by piece."""
    for start in range(0, len(points), _PIECE_POINTS):
        piece = points[start : start + _PIECE_POINTS]
        cells = ground_cells(piece, (0.0, 0.0), options.block_size_m)
        i, j = cells.T
        yield piece[(i >= low[0]) & (i <= high[0]) & (j >= low[1]) & (j <= high[1])]
