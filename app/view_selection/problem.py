"""What selection needs to know of one cluster: its views and its points, cut out of the scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.clustering.clusters import Cluster
from app.clustering.samples import grid_points, sample_axes
from app.errors import InputError
from app.occlusion.solid_columns import SolidColumns, solid_in_scene
from app.scene.point_index import PointIndex
from app.scene.posed_scene import PosedScene
from app.view_selection.options import Visibility


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
    keypoint_normals: NDArray[np.float64]
    """(K, 3) unit vectors, where the surface faces at each keypoint; see `PosedScene`."""
    observations: NDArray[np.int64]
    """(T, 2) keypoint and view, by track; empty where nobody asks for it."""
    samples_in_world: NDArray[np.float64]
    """(S, 3)"""
    solid: SolidColumns | None = None
    """What hides points from views; none where nobody asks for it."""


class ProblemCutter:
    """Cuts the problems of a grid's clusters out of a scene; each costs the cluster's size, not the scene's."""

    def __init__(self, scene: PosedScene) -> None:
        """Index a scene."""
        self._scene = scene
        self._image_from_world = scene.image_from_world
        self._sizes_px = scene.image_sizes_px
        self._centers = scene.centers_in_world
        self._points = PointIndex(scene.points_in_world)

    def problem(self, cluster: Cluster, visibility: Visibility) -> ViewProblem:
        """Cut out one cluster, with what a kind of visibility needs.

        Raises:
            InputError: the scene lacks one of its images.
        """
        scene = self._scene
        rows = scene.image_names.rows_of(cluster.image_names)
        if np.any(rows < 0):
            name = cluster.image_names[int(np.argmax(rows < 0))]
            raise InputError(
                f"image {name!r} of cluster {cluster.name} is not in the model; run `cityrecon cluster` again"
            )
        boxes = cluster.region().padded_boxes()
        boxes[:, :, 2] = cluster.z_range_m
        point_rows = self._points_in(boxes)
        observations = np.empty((0, 2), dtype=np.int64)
        if visibility is Visibility.TRACKS:
            observations = _observations(scene, rows, point_rows)
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
            keypoint_normals=scene.point_normals[point_rows].astype(np.float64),
            observations=observations,
            samples_in_world=np.concatenate([grid_points(sample_axes(box, spacing)) for box in boxes]),
            solid=self._solid(boxes, rows, spacing) if visibility is Visibility.OCCLUDED else None,
        )

    def _solid(self, boxes: NDArray[np.float64], image_rows: NDArray[np.int64], spacing: float) -> SolidColumns:
        """What is solid in the rectangle around a cluster and its views, also by what other images observe there."""
        ground = np.concatenate([boxes.reshape(-1, 3), self._centers[image_rows]])[:, :2]
        bounds = np.stack([ground.min(axis=0), ground.max(axis=0)])
        rows = self._points.rows_between(*bounds)
        return solid_in_scene(self._scene, rows, self._centers, bounds_m=bounds, column_m=spacing)

    def _points_in(self, boxes: NDArray[np.float64]) -> NDArray[np.int64]:
        """Rows of the points in a cluster's padded cells, in the order of their coordinates."""
        found = [self._points.rows_between(low, high) for low, high in boxes[:, :, :2]]
        rows = found[0] if len(found) == 1 else np.unique(np.concatenate(found))
        return rows[np.lexsort(self._scene.points_in_world[rows].T[::-1])]


def _observations(scene: PosedScene, image_rows: NDArray[np.int64], point_rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """(T, 2) index in ``point_rows`` and in ``image_rows`` (ascending) of each track element between them."""
    points, images = scene.observations(point_rows)
    views = np.minimum(np.searchsorted(image_rows, images), len(image_rows) - 1)
    here = image_rows[views] == images
    return np.stack([points[here], views[here]], axis=1)
