"""Compiled loops of view selection, on sets of cameras and points packed 64 to a word."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True)
def transpose_bits(bits: NDArray[np.uint64], num_columns: int) -> NDArray[np.uint64]:
    """(num_columns, ceil(rows / 64)) the transpose of a packed matrix (rows, words).

    Blocks of 64 by 64 are transposed by swapping halves of halves: H. S. Warren, Hacker's Delight, section 7-3.
    """
    out = np.zeros((num_columns, (len(bits) + 63) // 64), np.uint64)
    block = np.zeros(64, np.uint64)
    for word in range(out.shape[1]):
        num_rows = min(64, len(bits) - 64 * word)
        for column_word in range((num_columns + 63) // 64):
            block[:] = 0
            for row in range(num_rows):
                block[row] = bits[64 * word + row, column_word]
            half, mask = 32, np.uint64(0x00000000FFFFFFFF)
            while half:
                shift = np.uint64(half)
                for row in range(64):
                    if not row & half:
                        swapped = ((block[row] >> shift) ^ block[row + half]) & mask
                        block[row + half] ^= swapped
                        block[row] ^= swapped << shift
                half >>= 1
                mask ^= mask << np.uint64(half)
            for row in range(min(64, num_columns - 64 * column_word)):
                out[64 * column_word + row, word] = block[row]
    return out


@njit(cache=True)
def count_distinct(bits: NDArray[np.uint64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(D,) the first of each set of equal rows of a packed matrix (rows, words), and how many rows are like it."""
    size = 16
    while size < 2 * len(bits):
        size *= 2
    slots = np.full(size, -1, np.int64)
    first, counts = np.empty(len(bits), np.int64), np.zeros(len(bits), np.int64)
    num_distinct = 0
    for row in range(len(bits)):
        mixed = np.uint64(0)
        for word in range(bits.shape[1]):
            mixed = (mixed ^ bits[row, word]) * np.uint64(0x9E3779B97F4A7C15)
            mixed ^= mixed >> np.uint64(32)
        slot = np.int64(mixed & np.uint64(size - 1))
        while slots[slot] >= 0 and np.any(bits[first[slots[slot]]] != bits[row]):
            slot = (slot + 1) & (size - 1)
        if slots[slot] < 0:
            slots[slot] = num_distinct
            first[num_distinct] = row
            num_distinct += 1
        counts[slots[slot]] += 1
    return first[:num_distinct], counts[:num_distinct]


@njit(cache=True)
def resolution_on_surface(
    by_point: NDArray[np.uint64],
    points: NDArray[np.float64],
    normals: NDArray[np.float64],
    centers: NDArray[np.float64],
    focal_lengths_px: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """How well images show points, relative to the image that shows each best.

    Args:
        by_point: (n, words) images that see each point, packed.
        points: (n, 3) in the world.
        normals: (n, 3) unit vectors.
        centers: (N, 3) projection centres.
        focal_lengths_px: (N,)

    Returns:
        (N,) sum over the points that an image sees of ``f cos(theta) / d``, for focal length f, angle of incidence
        theta and distance d, divided by the largest for the point; and the distances of all points seen.
    """
    num_images = len(centers)
    total, resolution = np.zeros(num_images), np.empty(num_images)
    distances = np.empty(len(points) * num_images)
    num_seen = 0
    for point in range(len(points)):
        best = 0.0
        for image in range(num_images):
            resolution[image] = 0.0
            if not (by_point[point, image // 64] >> np.uint64(image % 64)) & np.uint64(1):
                continue
            square, along = 0.0, 0.0
            for axis in range(3):
                towards = centers[image, axis] - points[point, axis]
                square += towards * towards
                along += towards * normals[point, axis]
            distances[num_seen] = np.sqrt(square)
            num_seen += 1
            if along > 0.0:
                resolution[image] = focal_lengths_px[image] * along / square
                best = max(best, resolution[image])
        if best > 0.0:
            for image in range(num_images):
                total[image] += resolution[image] / best
    return total, distances[:num_seen]


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
    words = np.empty(bits.shape[1], np.int64)
    for a in range(len(bits)):
        num_words = 0
        for word in range(bits.shape[1]):
            if bits[a, word]:
                words[num_words] = word
                num_words += 1
        for b in range(a):
            shared = 0
            for word in words[:num_words]:
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
    keep = np.zeros(len(bits), np.bool_)
    kept = np.empty(len(bits), np.int64)
    num_kept = 0
    for row in range(len(bits)):
        implied = False
        for other in kept[:num_kept]:
            if bounds[other] < bounds[row]:
                continue
            implied = True
            for word in range(bits.shape[1]):
                if bits[other, word] & ~bits[row, word]:
                    implied = False
                    break
            if implied:
                break
        if not implied:
            keep[row] = True
            kept[num_kept] = row
            num_kept += 1
    return keep
