"""Pairs of images that observe the same keypoints: what methods work on that cluster by common visibility."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from app.scene.posed_scene import PosedScene

_OBSERVATION_PAIRS_AT_ONCE = 1 << 25


def image_pairs(scene: PosedScene) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """(Q,) point, first and second image of every pair of observations of a point, the images ascending."""
    return _pairs_of_points(scene, 0, len(scene.track_offsets) - 1)


def count_pairs(scene: PosedScene) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]:
    """(E,) the distinct pairs of images that observe common points, and how many; a part of the points at a time."""
    lengths = np.diff(scene.track_offsets)
    before = np.concatenate([[0], np.cumsum(lengths * (lengths - 1) // 2)])
    steps = np.arange(0, before[-1], _OBSERVATION_PAIRS_AT_ONCE)
    starts = [*np.unique(np.searchsorted(before, steps)), len(lengths)]
    counted = []
    for start, end in itertools.pairwise(starts):
        _, first, second = _pairs_of_points(scene, start, end)
        counted.append(np.unique(first << 32 | second, return_counts=True))
    keys, slot = np.unique(np.concatenate([keys for keys, _ in counted]), return_inverse=True)
    counts = np.bincount(slot, np.concatenate([counts for _, counts in counted]))
    return (keys >> 32).astype(np.int32), (keys & 0xFFFFFFFF).astype(np.int32), counts.astype(np.int32)


def _pairs_of_points(
    scene: PosedScene, start: int, end: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """See `image_pairs`, for the points from `start` to `end`."""
    offsets = scene.track_offsets[start : end + 1]
    lengths = np.diff(offsets)
    ends = np.repeat(offsets[1:], lengths)
    first = np.arange(offsets[0], offsets[-1])
    partners = ends - first - 1
    a = np.repeat(first, partners)
    b = a + 1 + np.arange(len(a)) - np.repeat(np.cumsum(partners) - partners, partners)
    point = np.repeat(np.repeat(np.arange(start, end), lengths), partners)
    return point, scene.track_images[a].astype(np.int64), scene.track_images[b].astype(np.int64)


def sum_by_pair(
    a: NDArray[np.int64], b: NDArray[np.int64], values: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64], NDArray[np.int64]]:
    """(E,) the distinct pairs, the sum of the values of each, and how often it occurs."""
    keys, slot, counts = np.unique(a << 32 | b, return_inverse=True, return_counts=True)
    return keys >> 32, keys & 0xFFFFFFFF, np.bincount(slot, values), counts
