"""COLMAP's scene clustering: recursive bisection of the match graph by METIS, with images of the other half added.

Written after what ``SceneClustering`` in COLMAP's src/colmap/scene/scene_clustering.cc does, as pycolmap can't call it
on its own; defaults and order of steps are those of that file. METIS is the one in pymetis, called as COLMAP's
graph_cut.cc does: k-way, all options at their defaults.
"""

from __future__ import annotations

import numpy as np
import pymetis
from numpy.typing import NDArray

from app.scene.posed_scene import PosedScene
from benchmarks.peers.tracks import image_pairs, sum_by_pair

_LEAF_MAX_NUM_IMAGES = 500
_IMAGE_OVERLAP = 50


def metis_clusters(scene: PosedScene) -> list[NDArray[np.int64]]:
    """Rows of the images of each leaf; two images match as often as they observe the same point."""
    _, first, second = image_pairs(scene)
    a, b, _, weights = sum_by_pair(first, second, np.ones(len(first)))
    leaves = []
    waiting = [(np.unique([a, b]), np.arange(len(a)), dict[int, int]())]
    while waiting:
        images, edges, anchors = waiting.pop()
        if len(edges) == 0 or len(images) <= _LEAF_MAX_NUM_IMAGES + _IMAGE_OVERLAP:
            leaves.append(images)
            continue
        label = _bisect(a[edges], b[edges], weights[edges], len(scene.image_names))
        for image, anchor in anchors.items():
            label[image] = label[anchor]
        label[label < 0] = 0
        crossing = edges[label[a[edges]] != label[b[edges]]]
        heaviest_first = crossing[np.argsort(-weights[crossing], kind="stable")]
        for side in (0, 1):
            own = images[label[images] == side]
            inner = edges[(label[a[edges]] == side) & (label[b[edges]] == side)]
            guests = _guests(a[heaviest_first], b[heaviest_first], label, side)
            child = np.unique(np.concatenate([own, np.array(list(guests), dtype=np.int64)]))
            if len(child) == len(images):
                leaves.append(child)
            elif len(child):
                waiting.append((child, inner, guests))
    return leaves


def _bisect(
    a: NDArray[np.int64], b: NDArray[np.int64], weights: NDArray[np.int64], num_images: int
) -> NDArray[np.int64]:
    """(num_images,) side of each image, -1 where it has no edge."""
    nodes, ends = np.unique(np.concatenate([a, b]), return_inverse=True)
    others, both = np.roll(ends, len(a)), np.tile(weights, 2)
    order = np.argsort(ends, kind="stable")
    starts = np.searchsorted(ends[order], np.arange(len(nodes) + 1))
    _, sides = pymetis.part_graph(2, xadj=starts, adjncy=others[order], eweights=both[order], recursive=False)
    label = np.full(num_images, -1, dtype=np.int64)
    label[nodes] = sides
    return label


def _guests(a: NDArray[np.int64], b: NDArray[np.int64], label: NDArray[np.int64], side: int) -> dict[int, int]:
    """Images of the other side on the heaviest edges, each with the image of this side that it goes with."""
    guests: dict[int, int] = {}
    for first, second in zip(a.tolist(), b.tolist(), strict=True):
        own, other = (first, second) if label[first] == side else (second, first)
        guests.setdefault(other, own)
        if len(guests) >= _IMAGE_OVERLAP:
            break
    return guests
