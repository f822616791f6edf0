"""A row of houses between two streets.

    y
20  |  . . . . . . . . . .      cameras of the other street
16  |  ====================     its facade
    |  ####################     houses, 8 m high
 8  |  ====================     facade of this street
 4  |  . . . . . . . . . .      cameras of this street
 0  |___________________________ x, from 0 to 30
"""

from __future__ import annotations

import numpy as np

from app.scene.posed_scene import PosedScene
from tests.reference.posed_scenes import level_camera, make_scene

STREET, OTHER_STREET = 4.0, 20.0


def facade(y: float, height: float = 8.0, spacing: float = 0.8) -> np.ndarray:
    """Keypoints on a wall along x."""
    x, z = np.meshgrid(np.arange(0.4, 30, spacing), np.arange(0.3, height + 0.01, spacing))
    return np.column_stack([x.ravel(), np.full(x.size, y), z.ravel()])


def cameras(y: float) -> np.ndarray:
    """Cameras along a street, 1.7 m high."""
    x = np.arange(1.0, 30.0, 2.0)
    return np.column_stack([x, np.full(len(x), y), np.full(len(x), 1.7)])


def two_streets() -> PosedScene:
    """The streets' images look at their own facades, ``here/...`` along +y and ``there/...`` along -y, and observe what
    lies within 15 m of them."""
    walls = {"here": (facade(8.0), cameras(STREET), 90.0), "there": (facade(16.0), cameras(OTHER_STREET), 270.0)}
    poses, points, tracks = {}, [], []
    for street, (wall, views, heading_deg) in walls.items():
        names = [f"{street}/{number:02d}.jpg" for number in range(len(views))]
        poses |= {name: level_camera(view, heading_deg) for name, view in zip(names, views, strict=True)}
        for point in wall:
            near = np.flatnonzero(np.linalg.norm(views - point, axis=1) < 15)
            points.append(point.tolist())
            tracks.append([names[view] for view in near])
    return make_scene(poses, points, tracks)
