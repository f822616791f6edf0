"""View clustering by normalized cuts as in [F]: Furukawa et al., Towards Internet-scale Multi-view Stereo, 2010.

Images are nodes; an edge weighs the mean over common keypoints of a Gaussian of the triangulation angle. The graph is
cut in two, again and again, until every cluster has at most 150 images (size constraint); then images are added until
enough keypoints are covered (coverage constraint), what has become too large is cut again, and so on. [F]'s removal of
redundant images before clustering is left out, so that all methods work on the same images. [F] adds one image
after the other in order of effect; here each cluster gets all of its images with at least 70 % of the largest effect.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.linalg import eigsh

from app.scene.posed_scene import PosedScene
from benchmarks.peers.angles import angle_weights
from benchmarks.peers.tracks import image_pairs, sum_by_pair

_MAX_IMAGES = 150
_MIN_ACCURACY = 0.7
"""lambda: a keypoint is covered if a cluster triangulates it this well, relative to all its images."""
_MIN_COVERAGE = 0.7
"""delta: share of the keypoints of each image that must be covered."""
_MAX_ROUNDS = 10
_MAX_ADDITIONS = 20


def normalized_cut_clusters(scene: PosedScene) -> list[NDArray[np.int64]]:
    """Rows of the images of each cluster."""
    points, a, b = image_pairs(scene)
    weights = angle_weights(scene.points_in_world, scene.centers_in_world, points, a, b)
    first, second, sums, counts = sum_by_pair(a, b, weights)
    num_images = len(scene.image_names)
    half = coo_array((sums / counts, (first, second)), shape=(num_images, num_images))
    graph = (half + half.T).tocsr()
    clusters = _cut_until_small([np.unique([first, second])], graph)
    coverage = _Coverage(scene, points, a, b, weights)
    for _ in range(_MAX_ROUNDS):
        clusters = coverage.add_images(clusters)
        if max(len(images) for images in clusters) <= _MAX_IMAGES:
            break
        clusters = _cut_until_small(clusters, graph)
    return clusters


def _cut_until_small(clusters: list[NDArray[np.int64]], graph: csr_array) -> list[NDArray[np.int64]]:
    small, waiting = [], list(clusters)
    while waiting:
        images = waiting.pop()
        if len(images) <= _MAX_IMAGES:
            small.append(images)
        else:
            waiting.extend(_normalized_cut(images, graph[images][:, images].tocoo()))
    return small


def _normalized_cut(images: NDArray[np.int64], graph: coo_array) -> list[NDArray[np.int64]]:
    """Two parts: along the second eigenvector, where the normalized cut is least (Shi and Malik, 2000)."""
    degrees = np.maximum(np.asarray(graph.sum(axis=1)).reshape(-1), 1e-12)
    scale = diags_array(1 / np.sqrt(degrees))
    # The eigenvectors decide where to cut, and every cut is allowed, so a rough solution will do.
    _, vectors = eigsh(scale @ graph @ scale, k=2, which="LA", v0=np.sqrt(degrees), tol=1e-3, maxiter=5000)
    order = np.argsort(vectors[:, 0] / np.sqrt(degrees), kind="stable")
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    low, high = np.minimum(rank[graph.row], rank[graph.col]), np.maximum(rank[graph.row], rank[graph.col])
    # What an edge from rank low to rank high adds to the cuts after low, ..., high - 1; every edge is there twice.
    steps = np.bincount(low, graph.data, len(order)) - np.bincount(high, graph.data, len(order))
    cut = np.cumsum(steps)[:-1] / 2
    inside = np.cumsum(degrees[order])
    cost = cut / inside[:-1] + cut / np.maximum(inside[-1] - inside[:-1], 1e-12)
    split = int(np.argmin(cost)) + 1
    return [np.sort(images[order[:split]]), np.sort(images[order[split:]])]


class _Coverage:
    """How well clusters triangulate the keypoints, and which images would help."""

    def __init__(
        self,
        scene: PosedScene,
        points: NDArray[np.int64],
        a: NDArray[np.int64],
        b: NDArray[np.int64],
        weights: NDArray[np.float64],
    ) -> None:
        self._num_images, self._num_points = len(scene.image_names), len(scene.point_ids)
        self._track_images = scene.track_images
        self._track_points = np.repeat(np.arange(self._num_points), np.diff(scene.track_offsets))
        order = np.argsort(np.concatenate([a, b]), kind="stable")
        self._image = np.concatenate([a, b])[order]
        self._partner = np.concatenate([b, a])[order]
        self._point, self._weight = np.tile(points, 2)[order], np.tile(weights, 2)[order]
        self._starts = np.searchsorted(self._image, np.arange(self._num_images + 1))
        self._accuracy_of_all = np.bincount(points, weights, self._num_points)

    def add_images(self, clusters: list[NDArray[np.int64]]) -> list[NDArray[np.int64]]:
        """Larger clusters, in which enough keypoints of every image are covered, or no image helps."""
        for _ in range(_MAX_ADDITIONS):
            best, cluster_of = self._best_clusters(clusters)
            covered = best >= _MIN_ACCURACY * self._accuracy_of_all
            seen = np.bincount(self._track_images, minlength=self._num_images)
            num_covered = np.bincount(self._track_images, covered[self._track_points], self._num_images)
            lacking = num_covered < _MIN_COVERAGE * seen
            wanted = ~covered & (np.bincount(self._track_points, lacking[self._track_images], self._num_points) > 0)
            if not wanted.any():
                break
            clusters = [
                np.union1d(images, self._helpers(images, wanted & (cluster_of == number)))
                for number, images in enumerate(clusters)
            ]
        return clusters

    def _pairs_of(self, images: NDArray[np.int64]) -> NDArray[np.int64]:
        """Rows of the pairs whose first image is one of these."""
        return np.concatenate([np.arange(self._starts[image], self._starts[image + 1]) for image in images])

    def _best_clusters(self, clusters: list[NDArray[np.int64]]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """(P,) accuracy of each keypoint in the cluster that triangulates it best, and which one that is."""
        best = np.full(self._num_points, -1.0)
        cluster_of = np.zeros(self._num_points, dtype=np.int64)
        for number, images in enumerate(clusters):
            rows = self._pairs_of(images)
            inside = np.zeros(self._num_images, dtype=np.bool_)
            inside[images] = True
            seen, slot = np.unique(self._point[rows], return_inverse=True)
            accuracy = np.bincount(slot, self._weight[rows] * inside[self._partner[rows]]) / 2
            better = accuracy > best[seen]
            best[seen[better]], cluster_of[seen[better]] = accuracy[better], number
        return best, cluster_of

    def _helpers(self, images: NDArray[np.int64], wanted: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Images that add the most accuracy to the wanted keypoints in a cluster."""
        rows = self._pairs_of(images)
        rows = rows[wanted[self._point[rows]]]
        gains = np.bincount(self._partner[rows], self._weight[rows], self._num_images)
        gains[images] = 0.0
        return np.flatnonzero(gains >= max(_MIN_COVERAGE * gains.max(initial=0.0), 1e-9))
