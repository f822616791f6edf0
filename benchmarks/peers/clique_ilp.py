"""View selection by cliques, after [M]: Mauro et al., An Integer Linear Programming Model for View Selection, 2014.

As [O] describes it: a coverage constraint per keypoint asks for at least one clique of the graph of the images that see
it; Bron-Kerbosch finds the maximal cliques, for each keypoint anew. Two images are joined if their similarity, the mean
over common keypoints of the Gaussian-weighted triangulation angle of [F], is high enough. A clique counts once two of
its images are selected. The clusters are those of the program; images see the keypoints that they observe.
"""

from __future__ import annotations

import networkx
import numpy as np
from numpy.typing import NDArray
from ortools.linear_solver import pywraplp

from app.clustering.clusters import find_blocks
from app.clustering.options import ClusteringOptions
from app.scene.posed_scene import PosedScene
from benchmarks.peers.angles import angle_weights
from benchmarks.reference.clustering import inside, padded_bounds

_IMAGES_OF_CLIQUE = 2
_MIN_SIMILARITY = 0.1


def clique_selections(scene: PosedScene) -> list[NDArray[np.int64]]:
    """Rows of the images selected in each cluster."""
    options = ClusteringOptions()
    blocks = find_blocks(scene, options)
    shift = np.round(np.array(blocks.grid.origin_m) / options.block_size_m).astype(int)
    selections = []
    for block in blocks.kept:
        bounds = [padded_bounds((i + shift[0], j + shift[1]), options) for i, j in block.cells]
        rows = np.flatnonzero(np.any([inside(scene, low, high) for low, high in bounds], axis=0))
        point, image = scene.observations(rows)
        own = np.isin(image, block.image_rows)
        visible = np.zeros((len(block.image_rows), len(rows)), dtype=np.bool_)
        visible[np.searchsorted(block.image_rows, image[own]), point[own]] = True
        similarity = _similarity(visible, scene.points_in_world[rows], scene.centers_in_world[block.image_rows])
        selections.append(block.image_rows[_select(visible, similarity >= _MIN_SIMILARITY)])
    return selections


def _similarity(
    visible: NDArray[np.bool_], points_in_world: NDArray[np.float64], centers_in_world: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(N_c, N_c) from 0 to 1; 0 for an image and itself."""
    similarity = np.zeros((len(visible), len(visible)))
    for image, row in enumerate(visible):
        others, points = np.nonzero(row & visible[:image])
        weights = angle_weights(points_in_world, centers_in_world, points, np.full(len(others), image), others)
        counts = np.bincount(others, minlength=image)
        similarity[image, :image] = np.bincount(others, weights, image) / np.maximum(counts, 1)
    return similarity + similarity.T


def _select(visible: NDArray[np.bool_], matchable: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(N_c,) a smallest set with a clique for every point of (N_c, P) that has one."""
    solver = pywraplp.Solver.CreateSolver("SCIP")
    x = [solver.BoolVar(f"x{view}") for view in range(len(visible))]
    for seeing in visible.T:
        views = np.flatnonzero(seeing)
        graph = networkx.from_numpy_array(matchable[np.ix_(views, views)])
        cliques = [clique for clique in networkx.find_cliques(graph) if len(clique) >= _IMAGES_OF_CLIQUE]
        if not cliques:
            continue
        counts = [solver.BoolVar("") for _ in cliques]
        solver.Add(solver.Sum(counts) >= 1)
        for clique, counting in zip(cliques, counts, strict=True):
            solver.Add(solver.Sum([x[views[node]] for node in clique]) >= _IMAGES_OF_CLIQUE * counting)
    solver.Minimize(solver.Sum(x))
    solver.Solve()
    return np.array([variable.solution_value() > 0.5 for variable in x])
