"""Small scenes for tests: cameras given by position and heading, points given by position and track."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from app.scene.posed_scene import ImageNames, PosedScene, projection_centers
from tests.reference.visibility import mean_directions

WIDTH, HEIGHT, FOCAL = 640, 400, 320.0


def level_camera(position: Sequence[float], heading_deg: float) -> np.ndarray:
    """(3, 4) cam_from_world of a level camera with z up; heading 0 looks along +x, 90 along +y."""
    angle = np.radians(heading_deg)
    forward = np.array([np.cos(angle), np.sin(angle), 0.0])
    down = np.array([0.0, 0.0, -1.0])
    rotation = np.stack([np.cross(down, forward), down, forward])
    return np.column_stack([rotation, -rotation @ np.asarray(position, dtype=float)])


def make_scene(
    cameras: dict[str, np.ndarray], points: Sequence[Sequence[float]], tracks: Sequence[Sequence[str]] | None = None
) -> PosedScene:
    """A scene of pinhole cameras; without tracks, every point is observed by the first two images."""
    names = tuple(sorted(cameras))
    tracks = tracks if tracks is not None else [names[:2]] * len(points)
    rows = [sorted(names.index(name) for name in track) for track in tracks]
    positions, poses = np.asarray(points, dtype=np.float64).reshape(-1, 3), np.array([cameras[name] for name in names])
    return PosedScene(
        image_names=ImageNames.of(names),
        image_ids=np.arange(1, len(names) + 1, dtype=np.int64),
        camera_index=np.zeros(len(names), dtype=np.int32),
        cam_from_world=poses,
        camera_ids=np.array([1], dtype=np.int64),
        camera_params_px=np.array([[FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2]]),
        camera_sizes_px=np.array([[WIDTH, HEIGHT]], dtype=np.int32),
        point_ids=np.arange(1, len(points) + 1, dtype=np.int64),
        points_in_world=positions,
        point_colors=np.full((len(points), 3), 128, dtype=np.uint8),
        point_normals=mean_directions(positions, [sorted(set(row)) for row in rows], projection_centers(poses)),
        track_offsets=np.concatenate([[0], np.cumsum([len(row) for row in rows])]).astype(np.int64),
        track_images=np.array([row for track in rows for row in track], dtype=np.int32),
    )


def random_scene(seed: int, num_images: int = 24, num_points: int = 200) -> PosedScene:
    """A crooked drive past patches of points, with a few points far away."""
    rng = np.random.default_rng(seed)
    path = np.cumsum(rng.normal([2.0, 0.0], 1.5, (num_images, 2)), axis=0)
    cameras = {
        f"cam{row % 3}/{row:04d}.jpg": level_camera([*path[row], rng.uniform(1, 2)], rng.uniform(0, 360))
        for row in range(num_images)
    }
    patches = rng.normal(path[rng.integers(0, num_images, 8)], 15.0)
    points = np.column_stack(
        [patches[rng.integers(0, 8, num_points)] + rng.normal(0, 4, (num_points, 2)), rng.uniform(0, 8, num_points)]
    )
    points[rng.random(num_points) < 0.02, :2] += rng.choice([-1e6, 3e3, 200])
    names = sorted(cameras)
    tracks = [rng.choice(names, size=rng.integers(2, 6), replace=False).tolist() for _ in range(num_points)]
    return make_scene(cameras, points.tolist(), tracks)


def shuffled(scene: PosedScene, seed: int) -> tuple[PosedScene, np.ndarray]:
    """The same scene with other point IDs, and so another order of points; and the new order."""
    order = np.random.default_rng(seed).permutation(len(scene.point_ids))
    tracks = [scene.track_images[scene.track_offsets[p] : scene.track_offsets[p + 1]] for p in order]
    return (
        PosedScene(
            image_names=scene.image_names,
            image_ids=scene.image_ids[::-1].copy(),
            camera_index=scene.camera_index,
            cam_from_world=scene.cam_from_world,
            camera_ids=scene.camera_ids,
            camera_params_px=scene.camera_params_px,
            camera_sizes_px=scene.camera_sizes_px,
            point_ids=scene.point_ids,
            points_in_world=scene.points_in_world[order],
            point_colors=scene.point_colors[order],
            point_normals=scene.point_normals[order],
            track_offsets=np.concatenate([[0], np.cumsum([len(track) for track in tracks])]).astype(np.int64),
            track_images=np.concatenate(tracks),
        ),
        order,
    )
