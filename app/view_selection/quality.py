"""How good each view of a cluster is for dense stereo, and which views are too close together to add parallax."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from app.view_selection.problem import ViewProblem
from app.view_selection.visibility import unpack_rows

MAX_KEYPOINTS = 1000
"""Quality is summed over at most this many keypoints, spread evenly over the cluster, which bounds time and memory."""
VIEWPOINT_ANGLE_DEG = 5.0
"""Views of one viewpoint lie within about this angle, seen from the surface. 5 degrees is the best triangulation angle
in the view score of Yao et al., MVSNet, 2018, section 4.1; below it the score falls off steeply."""
NUM_HEADINGS = 8


def view_quality(problem: ViewProblem, visible: NDArray[np.uint64]) -> NDArray[np.float64]:
    """Quality of each view for the surface of the cluster.

    Sum over the keypoints that the view sees of its resolution there, relative to the best view of that keypoint:
    ``rho = f cos(theta) / d`` pixels per metre, for focal length f, distance d and angle of incidence theta. Relative
    resolution is the scale weight of Goesele et al., Multi-View Stereo for Community Photo Collections, 2007, section
    4.1. The surface normal is approximated by the mean direction to the views that observe the keypoint, as in
    Mur-Artal et al., ORB-SLAM, 2015, section III.C; so a view of a wall's back counts nothing.

    Args:
        problem: N_c views and K keypoints.
        visible: (at least K, words) views that see each keypoint, packed.

    Returns:
        (N_c,)
    """
    chosen = _spread(len(problem.keypoints_in_world))
    towards, distances = _directions(problem, chosen)
    incidence = np.maximum(np.einsum("kni,ki->kn", towards, _normals(problem)[chosen]), 0.0)
    resolution = problem.focal_lengths_px * incidence / distances
    resolution[~_seen(problem, visible, chosen)] = 0.0
    best = resolution.max(axis=1, initial=0.0, keepdims=True)
    quality: NDArray[np.float64] = (resolution / np.where(best > 0, best, 1.0)).sum(axis=0)
    return quality


def viewpoints(problem: ViewProblem, visible: NDArray[np.uint64]) -> NDArray[np.int64]:
    """(N_c,) number of the viewpoint that each view belongs to.

    Views of one viewpoint stand in one cube and look in one of 8 headings. The cubes' size is the baseline that
    subtends 5 degrees at the median distance of what the views see.
    """
    chosen = _spread(len(problem.keypoints_in_world))
    _, distances = _directions(problem, chosen)
    seen = distances[_seen(problem, visible, chosen)]
    if len(seen) == 0:
        return np.arange(len(problem.image_names))
    size = 2 * math.tan(math.radians(VIEWPOINT_ANGLE_DEG / 2)) * float(np.median(seen))
    cubes = np.floor(problem.centers_in_world / size)
    azimuths = np.arctan2(problem.directions_in_world[:, 1], problem.directions_in_world[:, 0])
    headings = np.round(azimuths / (2 * math.pi / NUM_HEADINGS)) % NUM_HEADINGS
    _, numbers = np.unique(np.column_stack([cubes, headings]), axis=0, return_inverse=True)
    return numbers.reshape(-1).astype(np.int64)


def _spread(num_keypoints: int) -> slice:
    return slice(None, None, max(1, -(-num_keypoints // MAX_KEYPOINTS)))


def _seen(problem: ViewProblem, visible: NDArray[np.uint64], chosen: slice) -> NDArray[np.bool_]:
    """(k, N_c) which views see the chosen keypoints."""
    return unpack_rows(visible[: len(problem.keypoints_in_world)][chosen], len(problem.image_names))


def _directions(problem: ViewProblem, chosen: slice) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Unit vectors (k, N_c, 3) from keypoints to views, and distances (k, N_c)."""
    towards = problem.centers_in_world[None] - problem.keypoints_in_world[chosen, None]
    distances = np.maximum(np.linalg.norm(towards, axis=2), np.finfo(np.float64).tiny)
    return towards / distances[:, :, None], distances


def _normals(problem: ViewProblem) -> NDArray[np.float64]:
    """(K, 3) mean direction from each keypoint to the views that observe it; zero where none of the cluster does."""
    points, views = problem.observations.T
    towards = problem.centers_in_world[views] - problem.keypoints_in_world[points]
    towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    normals = np.zeros((len(problem.keypoints_in_world), 3))
    np.add.at(normals, points, towards)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normalised: NDArray[np.float64] = normals / np.where(lengths > 0, lengths, 1.0)
    return normalised
