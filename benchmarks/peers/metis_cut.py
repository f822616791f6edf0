"""COLMAP's scene clustering: recursive bisection of the match graph by METIS, with images of the other half added.

Written after what ``SceneClustering`` in COLMAP's src/colmap/scene/scene_clustering.cc does, as pycolmap can't call it
on its own; defaults and order of steps are those of that file. METIS is the one in pymetis, called as COLMAP's
graph_cut.cc does: k-way, all options at their defaults.
"""

from __future__ import annotations

import numpy as np
import pymetis
from numpy.typing import NDArray
from scipy.sparse import coo_array

from app.scene.posed_scene import PosedScene
from benchmarks.peers.tracks import count_pairs

_LEAF_MAX_NUM_IMAGES = 500
_IMAGE_OVERLAP = 50


def metis_clusters(scene: PosedScene) -> list[NDArray[np.int64]]:
    """Rows of the images of each leaf; two images match as often as they observe the same point."""
    a, b, weights = count_pairs(scene)
    leaves = []
    waiting = [(_distinct(a, b), np.arange(len(a), dtype=np.int32), dict[int, int]())]
    while waiting:
        images, edges, anchors = waiting.pop()
        if len(edges) == 0 or len(images) <= _LEAF_MAX_NUM_IMAGES + _IMAGE_OVERLAP:
            leaves.append(images)
            continue
        label = _bisect(images, a[edges], b[edges], weights[edges])
        for image, anchor in anchors.items():
            label[image] = label[anchor]
        label[label < 0] = 0
        side_of_a, side_of_b = label[a[edges]], label[b[edges]]
        crossing = edges[side_of_a != side_of_b]
        heaviest_first = crossing[np.argsort(-weights[crossing], kind="stable")]
        for side in (0, 1):
            own = images[label[images] == side]
            inner = edges[(side_of_a == side) & (side_of_b == side)]
            guests = _guests(a[heaviest_first], b[heaviest_first], label, side)
            child = np.unique(np.concatenate([own, np.array(list(guests), dtype=np.int64)]))
            if len(child) == len(images):
                leaves.append(child)
            elif len(child):
                waiting.append((child, inner, guests))
    return leaves


def _distinct(a: NDArray[np.int32], b: NDArray[np.int32]) -> NDArray[np.int64]:
    """The images of some edges, ascending."""
    present = np.zeros(max(a.max(initial=-1), b.max(initial=-1)) + 1, dtype=np.bool_)
    present[a] = present[b] = True
    return np.flatnonzero(present)


def _bisect(
    images: NDArray[np.int64], a: NDArray[np.int32], b: NDArray[np.int32], weights: NDArray[np.int32]
) -> NDArray[np.int8]:
    """Side of each image, by its row; -1 where it has no edge."""
    nodes = _distinct(a, b)
    node = np.zeros(images[-1] + 1, dtype=np.int32)
    node[nodes] = np.arange(len(nodes))
    half = coo_array((weights, (node[a], node[b])), shape=(len(nodes), len(nodes))).tocsr()
    graph = half + half.T
    adjacency = pymetis.CSRAdjacency(graph.indptr, graph.indices)
    _, sides = pymetis.part_graph(2, adjacency, eweights=graph.data, recursive=False)
    label = np.full(len(node), -1, dtype=np.int8)
    label[nodes] = sides
    return label


def _guests(a: NDArray[np.int32], b: NDArray[np.int32], label: NDArray[np.int8], side: int) -> dict[int, int]:
    """Images of the other side on the heaviest edges, each with the image of this side that it goes with."""
    guests: dict[int, int] = {}
    for first, second in zip(a, b, strict=True):
        own, other = (first, second) if label[first] == side else (second, first)
        guests.setdefault(int(other), int(own))
        if len(guests) >= _IMAGE_OVERLAP:
            break
    return guests
