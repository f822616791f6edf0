"""Nearest descriptors, found exactly.

COLMAP's matcher on a CPU searches an index that is built anew in each run (FAISS, inverted lists). Beside other work it
now and then lost half of a pair's matches, so that the same images gave another model. A matrix product of all
descriptors with all others takes about as long, finds a little more, and is exact in single precision: the sums are
whole numbers below 2^24, in whatever order.
"""

from __future__ import annotations

import numpy as np
import pycolmap
from numpy.typing import NDArray

_NORM = 512
"""Length of a descriptor, in COLMAP's bytes."""
_BLOCK = 1024
"""Descriptors compared with all others at once."""

Descriptors = NDArray[np.uint8]
Matches = NDArray[np.uint32]


def match_descriptors(first: Descriptors, second: Descriptors) -> Matches:
    """Pairs of descriptors that are each other's nearest, and clearly nearer than the second nearest.

    The distance is the angle; the two thresholds are COLMAP's (`SiftMatchingOptions`).

    Args:
        first: (N, 128) RootSIFT in bytes, of length 512.
        second: (M, 128).

    Returns:
        (K, 2) rows of ``first``, ascending, and of ``second``.
    """
    if min(len(first), len(second)) < 2:
        return np.zeros((0, 2), np.uint32)
    left, right = first.astype(np.float32), second.astype(np.float32)
    partner, is_clear = _nearest(left, right)
    rows = np.flatnonzero(is_clear)
    back, is_clear_back = _nearest(right[partner[rows]], left)
    rows = rows[is_clear_back & (back == rows)]
    return np.stack([rows, partner[rows]], axis=1).astype(np.uint32)


def _nearest(queries: NDArray[np.float32], others: NDArray[np.float32]) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """(N,) row of the nearest of (M, 128) others, and whether it is near, and clearly nearer than the second."""
    nearest = np.zeros(len(queries), np.intp)
    products = np.zeros((len(queries), 2), np.float32)
    for start in range(0, len(queries), _BLOCK):
        block = queries[start : start + _BLOCK] @ others.T
        rows, best = np.arange(len(block)), block.argmax(axis=1)
        nearest[start : start + _BLOCK] = best
        products[start : start + _BLOCK, 0] = block[rows, best]
        block[rows, best] = -1.0
        products[start : start + _BLOCK, 1] = block.max(axis=1)
    limits = pycolmap.SiftMatchingOptions()
    angle, second_angle = np.arccos(np.minimum(products / _NORM**2, 1.0)).T
    return nearest, (angle <= limits.max_distance) & (angle < limits.max_ratio * second_angle)
