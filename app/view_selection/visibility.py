"""Which views see which points, and which views match ([O] section 4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.scene.kernels import frustum_bits
from app.view_selection.kernels import share_at_least, transpose_bits
from app.view_selection.options import Visibility
from app.view_selection.problem import ViewProblem


def pack_rows(matrix: NDArray[np.bool_]) -> NDArray[np.uint64]:
    """(R, ceil(C / 64)) rows of a boolean matrix (R, C), column c in bit ``c % 64`` of word ``c // 64``."""
    padded = np.zeros((len(matrix), -(-matrix.shape[1] // 64) * 64), dtype=np.bool_)
    padded[:, : matrix.shape[1]] = matrix
    return np.packbits(padded, axis=1, bitorder="little").view("<u8").astype(np.uint64)


def unpack_rows(bits: NDArray[np.uint64], num_columns: int) -> NDArray[np.bool_]:
    """The inverse of :func:`pack_rows`."""
    flat = np.unpackbits(np.ascontiguousarray(bits.astype("<u8")).view(np.uint8), axis=1, bitorder="little")
    return flat[:, :num_columns].astype(np.bool_)


@dataclass(frozen=True, kw_only=True)
class VisiblePoints:
    """Which views see which of a cluster's points, packed in both directions. P_c points: keypoints, then samples."""

    by_view: NDArray[np.uint64]
    """(N_c, ceil(P_c / 64)) points that each view sees."""
    by_point: NDArray[np.uint64]
    """(P_c, ceil(N_c / 64)) views that see each point: the matrix B^T of [O]."""

    @property
    def num_seen(self) -> NDArray[np.int64]:
        """(N_c,) how many points each view sees."""
        counts: NDArray[np.int64] = np.bitwise_count(self.by_view).sum(axis=1, dtype=np.int64)
        return counts


def visible_points(problem: ViewProblem, visibility: Visibility) -> VisiblePoints:
    """Which views see each keypoint and each sample.

    Raises:
        ValueError: the problem was cut out for another visibility.
    """
    if visibility is Visibility.OCCLUDED:
        return _unhidden_points(problem)
    if visibility is Visibility.FRUSTUM:
        points = np.concatenate([problem.keypoints_in_world, problem.samples_in_world])
        by_view = frustum_bits(np.ascontiguousarray(points.T), problem.image_from_world, problem.sizes_px)
        return VisiblePoints(by_view=by_view, by_point=transpose_bits(by_view, len(points)))
    samples = frustum_bits(np.ascontiguousarray(problem.samples_in_world.T), problem.image_from_world, problem.sizes_px)
    tracked = np.zeros((len(problem.keypoints_in_world), len(problem.image_names)), dtype=np.bool_)
    tracked[problem.observations[:, 0], problem.observations[:, 1]] = True
    by_point = np.concatenate([pack_rows(tracked), transpose_bits(samples, len(problem.samples_in_world))])
    return VisiblePoints(by_view=transpose_bits(by_point, len(problem.image_names)), by_point=by_point)


def _unhidden_points(problem: ViewProblem) -> VisiblePoints:
    """All keypoints, and the samples that may be on a surface: outside of what is solid, and seen by two views."""
    if problem.solid is None:
        raise ValueError(f"cluster {problem.cluster} was cut out without what hides its points")
    points = np.concatenate([problem.keypoints_in_world, problem.samples_in_world])
    in_image = frustum_bits(np.ascontiguousarray(points.T), problem.image_from_world, problem.sizes_px)
    by_view = problem.solid.remove_hidden(in_image, problem.centers_in_world, points)
    by_point = transpose_bits(by_view, len(points))
    is_wanted = (np.bitwise_count(by_point).sum(axis=1) >= 2) & ~problem.solid.hold(points)
    is_wanted[: len(problem.keypoints_in_world)] = True
    by_point = by_point[is_wanted]
    return VisiblePoints(by_view=transpose_bits(by_point, len(by_view)), by_point=by_point)


def matching_views(visible: VisiblePoints, min_shared_points: int) -> NDArray[np.bool_]:
    """(N_c, N_c) the matrix S~ of [O] with a false diagonal: which pairs of views see that many common points."""
    matches: NDArray[np.bool_] = share_at_least(visible.by_view, min_shared_points)
    return matches
