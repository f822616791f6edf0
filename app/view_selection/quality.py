"""How good each view of a cluster is for dense stereo, and which views are too close together to add parallax."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.view_selection.kernels import resolution_on_surface
from app.view_selection.problem import ViewProblem
from app.view_selection.visibility import VisiblePoints

MAX_KEYPOINTS = 1000
"""Quality is summed over at most this many keypoints, spread evenly over the cluster, which bounds time and memory."""
VIEWPOINT_ANGLE_DEG = 5.0
"""Views of one viewpoint lie within about this angle, seen from the surface. 5 degrees is the best triangulation angle
in the view score of Yao et al., MVSNet, 2018, section 4.1; below it the score falls off steeply."""
NUM_HEADINGS = 8


@dataclass(frozen=True, kw_only=True)
class ViewQuality:
    """What each view of a cluster is worth."""

    quality: NDArray[np.float64]
    """(N_c,) at least 0."""
    viewpoint: NDArray[np.int64]
    """(N_c,) number of the viewpoint that each view belongs to."""


def view_quality(problem: ViewProblem, visible: VisiblePoints) -> ViewQuality:
    """Quality and viewpoint of each view, for the surface of the cluster.

    Quality is the sum over the keypoints that the view sees of its resolution there, relative to the best view of that
    keypoint: ``rho = f cos(theta) / d`` pixels per metre, for focal length f, distance d and angle of incidence theta.
    Relative resolution is the scale weight of Goesele et al., Multi-View Stereo for Community Photo Collections, 2007,
    section 4.1. A view of a wall's back counts nothing.

    Views of one viewpoint stand in one cube and look in one of 8 headings. The cubes' size is the baseline that
    subtends 5 degrees at the median distance of what the views see.
    """
    chosen = slice(None, None, max(1, -(-len(problem.keypoints_in_world) // MAX_KEYPOINTS)))
    num_keypoints = len(problem.keypoints_in_world)
    quality, distances = resolution_on_surface(
        visible.by_point[:num_keypoints][chosen],
        problem.keypoints_in_world[chosen],
        problem.keypoint_normals[chosen],
        problem.centers_in_world,
        problem.focal_lengths_px,
    )
    viewpoint = np.arange(len(problem.image_names))
    if len(distances):
        viewpoint = _viewpoints(problem, 2 * math.tan(math.radians(VIEWPOINT_ANGLE_DEG / 2)) * np.median(distances))
    return ViewQuality(quality=quality, viewpoint=viewpoint)


def _viewpoints(problem: ViewProblem, size: float) -> NDArray[np.int64]:
    """(N_c,) number of each view's cube and heading."""
    cubes = np.floor(problem.centers_in_world / size)
    azimuths = np.arctan2(problem.directions_in_world[:, 1], problem.directions_in_world[:, 0])
    headings = np.round(azimuths / (2 * math.pi / NUM_HEADINGS)) % NUM_HEADINGS
    _, numbers = np.unique(np.column_stack([cubes, headings]), axis=0, return_inverse=True)
    return numbers.reshape(-1).astype(np.int64)
