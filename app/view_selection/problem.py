"""What selection needs to know of one cluster: its views and its points, cut out of the scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.clustering.clusters import Cluster
from app.clustering.grid import CellIndex, GroundGrid
from app.clustering.samples import grid_points, sample_axes
from app.errors import InputError
from app.scene.posed_scene import PosedScene


@dataclass(frozen=True, kw_only=True)
class ViewProblem:
    """Views and points of one cluster: N_c views, K keypoints, S samples, T observations."""

    cluster: str
    image_names: tuple[str, ...]
    """Sorted."""
    image_from_world: NDArray[np.float64]
    """(N_c, 3, 4) K [R | t]."""
    sizes_px: NDArray[np.float64]
    """(N_c, 2) width, height."""
    focal_lengths_px: NDArray[np.float64]
    """(N_c,)"""
    centers_in_world: NDArray[np.float64]
    """(N_c, 3)"""
    directions_in_world: NDArray[np.float64]
    """(N_c, 3) unit vectors along the optical axes."""
    keypoints_in_world: NDArray[np.float64]
    """(K, 3) in the padded cells, in the order of their coordinates, so that no ID matters."""
    observations: NDArray[np.int64]
    """(T, 2) keypoint and view, by track."""
    samples_in_world: NDArray[np.float64]
    """(S, 3)"""


class ProblemCutter:
    """Cuts the problems of a grid's clusters out of a scene; each costs the cluster's size, not the scene's."""

    def __init__(self, scene: PosedScene, grid: GroundGrid) -> None:
        """Index a scene."""
        self._scene = scene
        self._row_of_image = {name: row for row, name in enumerate(scene.image_names)}
        self._image_from_world = scene.image_from_world
        self._sizes_px = scene.image_sizes_px
        self._centers = scene.centers_in_world
        reach = 2.0**40 * min(grid.block_size_m)
        self._point_rows = np.flatnonzero(np.all(np.abs(scene.points_in_world[:, :2] - grid.origin_m) < reach, axis=1))
        self._points = CellIndex(grid.cells_of(scene.points_in_world[self._point_rows]))

    def problem(self, cluster: Cluster) -> ViewProblem:
        """Cut out one cluster.

        Raises:
            InputError: the scene lacks one of its images.
        """
        scene = self._scene
        try:
            rows = np.array([self._row_of_image[name] for name in cluster.image_names], dtype=np.int64)
        except KeyError as error:
            raise InputError(
                f"image {error.args[0]!r} of cluster {cluster.name} is not in the model; run `cityrecon cluster` again"
            ) from error
        boxes = cluster.region().padded_boxes()
        boxes[:, :, 2] = cluster.z_range_m
        point_rows = self._points_in(cluster, boxes)
        spacing = cluster.grid.sample_spacing_m
        return ViewProblem(
            cluster=cluster.name,
            image_names=cluster.image_names,
            image_from_world=self._image_from_world[rows],
            sizes_px=self._sizes_px[rows],
            focal_lengths_px=scene.camera_params_px[scene.camera_index[rows], :2].mean(axis=1),
            centers_in_world=self._centers[rows],
            directions_in_world=scene.cam_from_world[rows, 2, :3],
            keypoints_in_world=scene.points_in_world[point_rows],
            observations=_observations(scene, rows, point_rows),
            samples_in_world=np.concatenate([grid_points(sample_axes(box, spacing)) for box in boxes]),
        )

    def _points_in(self, cluster: Cluster, boxes: NDArray[np.float64]) -> NDArray[np.int64]:
        """Rows of the points in a cluster's padded cells, in the order of their coordinates."""
        around = [self._points.rows_around(cell, (1, 1)) for cell in cluster.cells]
        rows = self._point_rows[np.unique(np.concatenate(around))]
        points = self._scene.points_in_world[rows]
        inside = np.zeros(len(rows), dtype=np.bool_)
        for low, high in boxes[:, :, :2]:
            inside |= np.all((points[:, :2] >= low) & (points[:, :2] <= high), axis=1)
        rows, points = rows[inside], points[inside]
        return rows[np.lexsort(points.T[::-1])]


def _observations(scene: PosedScene, image_rows: NDArray[np.int64], point_rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """(T, 2) index in ``point_rows`` and in ``image_rows`` (ascending) of each track element between them."""
    lengths = np.diff(scene.track_offsets)[point_rows]
    starts = np.repeat(scene.track_offsets[point_rows] - np.cumsum(lengths) + lengths, lengths)
    images = scene.track_images[starts + np.arange(lengths.sum())]
    views = np.minimum(np.searchsorted(image_rows, images), len(image_rows) - 1)
    here = image_rows[views] == images
    return np.stack([np.repeat(np.arange(len(point_rows)), lengths)[here], views[here]], axis=1)
