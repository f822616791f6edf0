"""Textured planes seen by pinhole cameras, rendered analytically: the truth for tests of dense stereo."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from mvs_backends.base import MvsJob, MvsView


def texture(points: NDArray[np.float64], seed: int, scale: float) -> NDArray[np.float64]:
    """Grey values of (..., 3) points: a sum of random plane waves, the finest about 0.15 `scale` long."""
    rng = np.random.default_rng(seed)
    value = np.zeros(points.shape[:-1])
    for _ in range(24):
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        wave = 2 * np.pi / (scale * np.exp(rng.uniform(np.log(0.15), np.log(1.5))))
        value += np.sin(points @ direction * wave + rng.uniform(0, 2 * np.pi))
    return 128 + 30 * value / np.sqrt(12)


def look(position: NDArray[np.float64], target: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 4) cam_from_world of a camera at `position` that looks at `target`; world y is down."""
    z = (target - position) / np.linalg.norm(target - position)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    return np.concatenate([rotation, (-rotation @ position)[:, None]], axis=1)


def true_depth(view: MvsView, normal: NDArray[np.float64], offset: float) -> NDArray[np.float64]:
    """(H, W) camera z of the plane ``normal . X = offset`` in a view."""
    rotation, translation = view.cam_from_world[:, :3], view.cam_from_world[:, 3]
    pixels = np.stack(
        [*np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5), np.ones((view.height, view.width))],
        axis=-1,
    )
    rays = pixels @ np.linalg.inv(view.calibration).T @ rotation
    center = -rotation.T @ translation
    depth: NDArray[np.float64] = (offset - normal @ center) / (rays @ normal)
    return depth


def plane_job(
    folder: Path,
    *,
    normal: tuple[float, float, float],
    offset: float = 5.0,
    scale: float = 1.0,
    size: tuple[int, int] = (112, 80),
    num_views: int = 4,
    seed: int = 0,
    num_points: int = 60,
    bare: tuple[float, float] = (0.0, 0.0),
) -> MvsJob:
    """A dense workspace of views of the plane ``normal . X = offset``, all lengths times `scale`.

    Where |x| and |y| are less than `bare`, the plane has no texture.

       x x x x      cameras side by side at z = 0, 0.5 apart, looking along z
        \\| |/
    ============    the plane, about 5 away
    """
    direction = np.asarray(normal, np.float64) / np.linalg.norm(normal)
    distance = offset * scale
    width, height = size
    calibration = np.array([[1.1 * width, 0, width / 2], [0, 1.1 * width, height / 2], [0, 0, 1.0]])
    views = []
    for i in range(num_views):
        x = 0.5 * scale * (i - (num_views - 1) / 2)
        pose = look(np.array([x, 0.1 * scale * (i % 2), 0.0]), np.array([0.3 * x, 0.0, 5.0 * scale]))
        views.append(
            MvsView(name=f"cam/{i:03d}.png", width=width, height=height, calibration=calibration, cam_from_world=pose)
        )
    (folder / "images" / "cam").mkdir(parents=True)
    for view in views:
        seen = _points(view, direction, distance)
        grey = texture(seen, seed, scale)
        grey[(np.abs(seen[..., :2]) < np.array(bare) * scale).all(axis=-1)] = 128
        cv2.imwrite(str(folder / "images" / view.name), np.clip(np.round(grey), 0, 255).astype(np.uint8))
    rng = np.random.default_rng(seed + 1)
    surface = _points(views[num_views // 2], direction, distance).reshape(-1, 3)
    points = surface[rng.choice(len(surface), num_points, replace=False)]
    return MvsJob(
        workspace=folder,
        views=tuple(views),
        sources=tuple(tuple(j for j in range(num_views) if j != i) for i in range(num_views)),
        boxes_in_world=scale * np.array([[[-8.0, -8.0, 2.0], [8.0, 8.0, 12.0]]]),
        points_in_world=points,
        point_views=tuple(np.arange(num_points) for _ in views),
    )


def write_model(job: MvsJob) -> None:
    """Write the job's COLMAP model, and the folders for its maps, as `app.dense_job` does."""
    model = pycolmap.Reconstruction()
    tracks = [pycolmap.Track() for _ in job.points_in_world]
    for number, (view, seen) in enumerate(zip(job.views, job.point_views, strict=True), start=1):
        k = view.calibration
        params = [k[0, 0], k[1, 1], k[0, 2], k[1, 2]]
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(camera_id=number, model="PINHOLE", width=view.width, height=view.height, params=params)
        )
        pixels = (job.points_in_world[seen] @ view.cam_from_world[:, :3].T + view.cam_from_world[:, 3]) @ k.T
        image = pycolmap.Image(name=view.name, camera_id=number, image_id=number)
        image.points2D = [pycolmap.Point2D(xy) for xy in pixels[:, :2] / pixels[:, 2:]]
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(view.cam_from_world))
        for row, point in enumerate(seen):
            tracks[point].add_element(number, row)
        for path in (job.depth_map_path(number - 1), job.normal_map_path(number - 1)):
            path.parent.mkdir(parents=True, exist_ok=True)
    for point, track in zip(job.points_in_world, tracks, strict=True):
        model.add_point3D(point, track)
    (job.workspace / "sparse").mkdir()
    model.write_binary(job.workspace / "sparse")


def _points(view: MvsView, normal: NDArray[np.float64], offset: float) -> NDArray[np.float64]:
    depth = true_depth(view, normal, offset)
    pixels = np.stack(
        [*np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5), np.ones(depth.shape)], axis=-1
    )
    in_camera = pixels @ np.linalg.inv(view.calibration).T * depth[..., None]
    points: NDArray[np.float64] = (in_camera - view.cam_from_world[:, 3]) @ view.cam_from_world[:, :3]
    return points
