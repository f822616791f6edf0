"""Compiled loops of view selection, on sets of cameras and points packed 64 to a word."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from app.scene.kernels import sees


@njit(cache=True)
def frustum_bits(
    points: NDArray[np.float64], image_from_world: NDArray[np.float64], sizes_px: NDArray[np.float64]
) -> NDArray[np.uint64]:
    """Which images each point projects into.

    Args:
        points: (P, 3) in the world.
        image_from_world: (N, 3, 4) K [R | t].
        sizes_px: (N, 2) width, height.

    Returns:
        (P, ceil(N / 64)) bit ``i % 64`` of word ``i // 64`` stands for image i.
    """
    num_images = len(image_from_world)
    bits = np.zeros((len(points), (num_images + 63) // 64), np.uint64)
    for image in range(num_images):
        matrix, size_px = image_from_world[image], sizes_px[image]
        word, shift = image // 64, np.uint64(image % 64)
        for point in range(len(points)):
            bits[point, word] |= np.uint64(sees(matrix, size_px, points[point])) << shift
    return bits


@njit(cache=True)
def transpose_bits(bits: NDArray[np.uint64], num_columns: int) -> NDArray[np.uint64]:
    """(num_columns, ceil(rows / 64)) the transpose of a packed matrix (rows, words)."""
    out = np.zeros((num_columns, (len(bits) + 63) // 64), np.uint64)
    for row in range(len(bits)):
        word, bit = row // 64, np.uint64(1) << np.uint64(row % 64)
        for column in range(num_columns):
            if (bits[row, column // 64] >> np.uint64(column % 64)) & np.uint64(1):
                out[column, word] |= bit
    return out


@njit(cache=True)
def _count_ones(word: np.uint64) -> np.int64:
    word -= (word >> np.uint64(1)) & np.uint64(0x5555555555555555)
    word = (word & np.uint64(0x3333333333333333)) + ((word >> np.uint64(2)) & np.uint64(0x3333333333333333))
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((word * np.uint64(0x0101010101010101)) >> np.uint64(56))


@njit(cache=True)
def share_at_least(bits: NDArray[np.uint64], min_shared: int) -> NDArray[np.bool_]:
    """(N, N) whether two different rows of a packed matrix (N, words) have ``min_shared`` or more bits in common."""
    out = np.zeros((len(bits), len(bits)), np.bool_)
    for a in range(len(bits)):
        for b in range(a):
            shared = 0
            for word in range(bits.shape[1]):
                shared += int(_count_ones(bits[a, word] & bits[b, word]))
                if shared >= min_shared:
                    out[a, b] = True
                    out[b, a] = True
                    break
    return out


@njit(cache=True)
def undominated(bits: NDArray[np.uint64], bounds: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which covering rows remain when rows that others imply are removed.

    A row "at least ``bound`` of these cameras" is implied by another one with a subset of its cameras and at least the
    same bound.

    Args:
        bits: (R, words) distinct rows, sorted so that no row is a subset of an earlier one with fewer cameras: by
            ascending number of cameras.
        bounds: (R,)

    Returns:
        (R,)
    """
    keep = np.ones(len(bits), np.bool_)
    for row in range(len(bits)):
        for other in range(row):
            if not keep[other] or bounds[other] < bounds[row]:
                continue
            implied = True
            for word in range(bits.shape[1]):
                if bits[other, word] & ~bits[row, word]:
                    implied = False
                    break
            if implied:
                keep[row] = False
                break
    return keep
