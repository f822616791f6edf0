"""Pairs of images that observe the same keypoints: what methods work on that cluster by common visibility."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from app.scene.posed_scene import PosedScene


def image_pairs(scene: PosedScene) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """(Q,) point, first and second image of every pair of observations of a point, the images ascending."""
    lengths = np.diff(scene.track_offsets)
    ends = np.repeat(scene.track_offsets[1:], lengths)
    first = np.arange(len(scene.track_images))
    partners = ends - first - 1
    a = np.repeat(first, partners)
    b = a + 1 + np.arange(len(a)) - np.repeat(np.cumsum(partners) - partners, partners)
    point = np.repeat(np.repeat(np.arange(len(lengths)), lengths), partners)
    return point, scene.track_images[a].astype(np.int64), scene.track_images[b].astype(np.int64)


def sum_by_pair(
    a: NDArray[np.int64], b: NDArray[np.int64], values: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64], NDArray[np.int64]]:
    """(E,) the distinct pairs, the sum of the values of each, and how often it occurs."""
    keys, slot, counts = np.unique(a << 32 | b, return_inverse=True, return_counts=True)
    return keys >> 32, keys & 0xFFFFFFFF, np.bincount(slot, values), counts
