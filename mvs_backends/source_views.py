"""Source views of each reference view: which other images its depth is searched in."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mvs_backends.base import MvsView

_BEST_ANGLE_DEG = 8.0
_NARROW_SIGMA_DEG = 4.0
_WIDE_SIGMA_DEG = 15.0


def choose_source_views(
    *,
    views: Sequence[MvsView],
    points_in_world: NDArray[np.float64],
    point_views: Sequence[NDArray[np.int64]],
    samples_in_world: NDArray[np.float64],
    max_sources: int,
) -> tuple[tuple[int, ...], ...]:
    """Choose source views by what they see of the same surface, from where, and how large.

    A pair's score sums over the sparse points that both observe, and over the surface samples that project into both
    images, a weight of the triangulation angle (a narrow one says little about depth, a wide one looks different)
    times the ratio of image scales (at most 1). Sparse points count ten times a sample: they are known to be matched
    in both. Independent of the order of points and samples.

    Args:
        views: all views of the cluster.
        points_in_world: (P, 3) sparse points.
        point_views: per view, indices of the sparse points that it observes.
        samples_in_world: (S, 3) samples of the surface of interest; may be empty. Occlusion isn't tested.
        max_sources: source views per reference view, at most.

    Returns:
        Per view, indices of its source views, best first; ties by index. Views that share nothing are left out.
    """
    count = len(views)
    everything = np.concatenate([points_in_world.reshape(-1, 3), samples_in_world.reshape(-1, 3)])
    seen = np.zeros((count, len(everything)), np.bool_)
    scale = np.zeros((count, len(everything)), np.float32)
    for i, view in enumerate(views):
        in_camera = everything @ view.cam_from_world[:, :3].T + view.cam_from_world[:, 3]
        pixels = in_camera @ view.calibration.T
        front = in_camera[:, 2] > 1e-9
        depth = np.where(front, in_camera[:, 2], 1.0)
        x, y = pixels[:, 0] / depth, pixels[:, 1] / depth
        seen[i] = front & (x >= 0) & (x < view.width) & (y >= 0) & (y < view.height)
        seen[i, : len(points_in_world)] = False
        seen[i, point_views[i]] = True
        scale[i] = np.where(front, view.calibration[0, 0] / depth, 0.0)
    weight = np.ones(len(everything), np.float32)
    weight[: len(points_in_world)] = 10.0
    centers = np.stack([-view.cam_from_world[:, :3].T @ view.cam_from_world[:, 3] for view in views])
    score = np.zeros((count, count))
    for i in range(count):
        index = np.flatnonzero(seen[i])
        rays = _unit(everything[index] - centers[i])
        for j in range(i + 1, count):
            both = seen[j, index]
            shared = index[both]
            if len(shared) == 0:
                continue
            other = _unit(everything[shared] - centers[j])
            angle = np.degrees(np.arccos(np.clip(np.sum(rays[both] * other, axis=1), -1.0, 1.0)))
            sigma = np.where(angle < _BEST_ANGLE_DEG, _NARROW_SIGMA_DEG, _WIDE_SIGMA_DEG)
            fitness = np.exp(-((angle - _BEST_ANGLE_DEG) ** 2) / (2 * sigma**2))
            larger = np.maximum(scale[i, shared], scale[j, shared])
            ratio = np.minimum(scale[i, shared], scale[j, shared]) / np.where(larger > 0, larger, 1)
            score[i, j] = score[j, i] = np.round(np.sum(weight[shared] * fitness * ratio), 6)
    chosen = []
    for i in range(count):
        order = sorted((j for j in range(count) if score[i, j] > 0), key=lambda j: (-score[i, j], j))
        chosen.append(tuple(order[:max_sources]))
    return tuple(chosen)


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    unit: NDArray[np.float64] = vectors / np.where(length > 0, length, 1)
    return unit
