"""Which views see which points, and which views match ([O] section 4)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from app.view_selection.kernels import frustum_bits, share_at_least, transpose_bits
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


def visible_points(problem: ViewProblem, visibility: Visibility) -> NDArray[np.uint64]:
    """(P_c, words) the matrix B^T of [O]: which views see each keypoint and each sample, packed."""
    if visibility is Visibility.FRUSTUM:
        points = np.concatenate([problem.keypoints_in_world, problem.samples_in_world])
        return frustum_bits(points, problem.image_from_world, problem.sizes_px)
    tracked = np.zeros((len(problem.keypoints_in_world), len(problem.image_names)), dtype=np.bool_)
    tracked[problem.observations[:, 0], problem.observations[:, 1]] = True
    samples = frustum_bits(problem.samples_in_world, problem.image_from_world, problem.sizes_px)
    return np.concatenate([pack_rows(tracked), samples])


def matching_views(
    visible: NDArray[np.uint64], num_views: int, min_shared_points: int
) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Which pairs of views match, and how many points each view sees.

    Args:
        visible: From :func:`visible_points`.
        num_views: N_c.
        min_shared_points: Common points that make two views match.

    Returns:
        (N_c, N_c) the matrix S~ of [O] with a false diagonal, and (N_c,).
    """
    by_view = transpose_bits(visible, num_views)
    return share_at_least(by_view, min_shared_points), np.bitwise_count(by_view).sum(axis=1, dtype=np.int64)
