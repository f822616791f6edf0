"""Quality and viewpoint of each view, as `optimal` selection defines them; the formulas are in app/view_selection."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from app.scene.posed_scene import PosedScene
from app.view_selection.quality import MAX_KEYPOINTS, NUM_HEADINGS, VIEWPOINT_ANGLE_DEG
from benchmarks.reference.selection import PlainProgram


def plain_quality(scene: PosedScene, program: PlainProgram) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """(N_c,) sum of relative resolutions, and (N_c,) number of the viewpoint."""
    images = list(program.images)
    centers = scene.centers_in_world[images]
    focal = scene.camera_params_px[scene.camera_index[images], :2].mean(axis=1)
    quality, distances = np.zeros(len(images)), []
    step = max(1, math.ceil(len(program.keypoints) / MAX_KEYPOINTS))
    for column in range(0, len(program.keypoints), step):
        row = program.keypoints[column]
        towards = centers - scene.points_in_world[row]
        distance = np.linalg.norm(towards, axis=1)
        cosine = towards @ scene.point_normals[row].astype(np.float64) / distance
        resolution = np.where(program.visible[:, column], focal * np.maximum(cosine, 0.0) / distance, 0.0)
        if resolution.max() > 0:
            quality += resolution / resolution.max()
        distances.extend(distance[program.visible[:, column]].tolist())
    if not distances:
        return quality, np.arange(len(images))
    cube = 2 * math.tan(math.radians(VIEWPOINT_ANGLE_DEG / 2)) * float(np.median(distances))
    numbers: dict[tuple[int, ...], int] = {}
    viewpoint = []
    for center, (ahead_x, ahead_y, _) in zip(centers, scene.cam_from_world[images, 2, :3], strict=True):
        heading = round(math.atan2(ahead_y, ahead_x) / (2 * math.pi / NUM_HEADINGS)) % NUM_HEADINGS
        place = (*(math.floor(value / cube) for value in center), heading)
        viewpoint.append(numbers.setdefault(place, len(numbers)))
    return quality, np.array(viewpoint)
