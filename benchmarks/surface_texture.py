"""Ground-truth surfaces: how much texture the images show of them, and whose normals are right."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import open3d as o3d
import trimesh
from numpy.typing import NDArray

from fusion.cloud import PointCloud
from mvs_backends.base import MvsJob

_WINDOW_PX = 11
_OCCLUSION_TOLERANCE = 0.01


def texture_of_samples(job: MvsJob, samples: NDArray[np.float32], mesh: Path) -> NDArray[np.float32]:
    """Median over the images of the standard deviation of grey values around each sample.

    Args:
        job: a dense workspace in the frame of the samples.
        samples: (S, 3)
        mesh: the surfaces, which hide samples from images.

    Returns:
        (S,) in grey values of 0 to 255, in windows of 11 x 11 pixels; NaN for samples that no image sees.
    """
    scene = _scene_of(mesh)
    texture = np.full((len(job.views), len(samples)), np.nan, np.float32)
    for number, view in enumerate(job.views):
        grey = cv2.imread(str(job.image_path(number)), cv2.IMREAD_GRAYSCALE).astype(np.float64)
        size = (_WINDOW_PX, _WINDOW_PX)
        variance = cv2.blur(grey * grey, size) - cv2.blur(grey, size) ** 2
        in_camera = samples @ view.cam_from_world[:, :3].T + view.cam_from_world[:, 3]
        pixels = in_camera @ view.calibration.T
        columns, rows = np.floor(pixels[:, :2] / np.maximum(pixels[:, 2:], 1e-9)).astype(np.int64).T
        inside = (in_camera[:, 2] > 0) & (columns >= 0) & (rows >= 0) & (columns < view.width) & (rows < view.height)
        center = -view.cam_from_world[:, :3].T @ view.cam_from_world[:, 3]
        rays = np.empty((int(inside.sum()), 6), np.float32)
        rays[:, :3], rays[:, 3:] = center, samples[inside] - center
        # A ray's parameter is 1 at its sample.
        unhidden = scene.cast_rays(o3d.core.Tensor.from_numpy(rays))["t_hit"].numpy() > 1 - _OCCLUSION_TOLERANCE
        seen = np.flatnonzero(inside)[unhidden]
        texture[number, seen] = np.sqrt(np.maximum(variance[rows[seen], columns[seen]], 0))
    result = np.full(len(samples), np.nan, np.float32)
    known = ~np.isnan(texture).all(axis=0)
    result[known] = np.nanmedian(texture[:, known], axis=0)
    return result


def normal_errors(cloud: PointCloud, mesh: Path, reach_m: float) -> NDArray[np.float32]:
    """Angles in degrees between the normals of the points within reach of a mesh and those of its triangles."""
    found = _scene_of(mesh).compute_closest_points(o3d.core.Tensor.from_numpy(cloud.points))
    near = np.linalg.norm(found["points"].numpy() - cloud.points, axis=1) < reach_m
    cosines = np.abs(np.sum(found["primitive_normals"].numpy() * cloud.normals, axis=1))[near]
    angles: NDArray[np.float32] = np.degrees(np.arccos(np.minimum(cosines, 1)))
    return angles


def nearest(points: NDArray[np.float32], samples: NDArray[np.float32]) -> NDArray[np.int64]:
    """(P,) index of the sample nearest to each point."""
    search = o3d.core.nns.NearestNeighborSearch(o3d.core.Tensor.from_numpy(samples))
    search.knn_index()
    index: NDArray[np.int64] = (
        search.knn_search(o3d.core.Tensor.from_numpy(points), 1)[0].numpy()[:, 0].astype(np.int64)
    )
    return index


def _scene_of(mesh: Path) -> o3d.t.geometry.RaycastingScene:
    surface = trimesh.load_mesh(mesh, process=False)
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(
        o3d.core.Tensor.from_numpy(np.asarray(surface.vertices, dtype=np.float32)),
        o3d.core.Tensor.from_numpy(np.asarray(surface.faces, dtype=np.uint32)),
    )
    return scene
