"""A scene to compile the kernels with, before several processes need them at once."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from mvs_backends.base import MvsJob, MvsView

_WIDTH, _HEIGHT, _SHIFT_PX = 64, 48, 4
_FOCAL_PX, _DEPTH = 64.0, 8.0


def tiny_job(folder: Path) -> MvsJob:
    """A job that takes a moment and needs every kernel.

    x   x   x    three cameras side by side
    |   |   |
    ==---------  a wall, textured and nearly plain
    """
    texture = np.random.default_rng(0).integers(0, 255, (_HEIGHT // 2, _WIDTH), np.uint8)
    texture = np.asarray(cv2.resize(texture, (2 * _WIDTH, _HEIGHT), interpolation=cv2.INTER_CUBIC), np.uint8)
    texture[:, _WIDTH // 2 :] = 120 + texture[:, _WIDTH // 2 :] // 24
    calibration = np.array([[_FOCAL_PX, 0, _WIDTH / 2], [0, _FOCAL_PX, _HEIGHT / 2], [0, 0, 1.0]])
    (folder / "images").mkdir(parents=True)
    views = []
    for index in range(3):
        pose = np.eye(3, 4)
        pose[0, 3] = -index * _SHIFT_PX * _DEPTH / _FOCAL_PX
        name, start = f"{index}.png", index * _SHIFT_PX
        views.append(MvsView(name=name, width=_WIDTH, height=_HEIGHT, calibration=calibration, cam_from_world=pose))
        cv2.imwrite(str(folder / "images" / name), texture[:, start : start + _WIDTH])
    x, y = np.meshgrid(np.linspace(-3, 3, 8), np.linspace(-2, 2, 6))
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, _DEPTH)], axis=1)
    return MvsJob(
        workspace=folder,
        views=tuple(views),
        sources=((1, 2), (0, 2), (0, 1)),
        boxes_in_world=np.array([[[-9.0, -9.0, 4.0], [9.0, 9.0, 16.0]]]),
        points_in_world=points,
        point_views=(np.arange(len(points)),) * 3,
    )
