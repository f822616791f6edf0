"""View selection by cliques, after [M]: Mauro et al., An Integer Linear Programming Model for View Selection, 2014.

As [O] describes it: a coverage constraint per keypoint asks for at least one clique of the graph of the images that see
it, edges being matchable pairs; Bron-Kerbosch finds the maximal cliques, for each keypoint anew. A clique counts once
two of its images are selected. The clusters are those of the program; images see the keypoints that project into them.
"""

from __future__ import annotations

import networkx
import numpy as np
from numpy.typing import NDArray
from ortools.linear_solver import pywraplp

from app.clustering.clusters import find_blocks
from app.clustering.options import ClusteringOptions
from app.scene.posed_scene import PosedScene
from app.view_selection.options import SelectionOptions
from benchmarks.reference.clustering import inside, padded_bounds, sees

_IMAGES_OF_CLIQUE = 2


def clique_selections(scene: PosedScene) -> list[NDArray[np.int64]]:
    """Rows of the images selected in each cluster."""
    options = ClusteringOptions()
    blocks = find_blocks(scene, options)
    shift = np.round(np.array(blocks.grid.origin_m) / options.block_size_m).astype(int)
    selections = []
    for block in blocks.kept:
        bounds = [padded_bounds((i + shift[0], j + shift[1]), options) for i, j in block.cells]
        keypoints = scene.points_in_world[np.any([inside(scene, low, high) for low, high in bounds], axis=0)]
        visible = np.array([sees(scene, image, keypoints) for image in block.image_rows])
        shared = visible.astype(np.float32) @ visible.astype(np.float32).T
        matchable = shared >= SelectionOptions().min_shared_points
        selections.append(block.image_rows[_select(visible, matchable)])
    return selections


def _select(visible: NDArray[np.bool_], matchable: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(N_c,) a smallest set with a clique for every point of (N_c, P) that has one."""
    solver = pywraplp.Solver.CreateSolver("SCIP")
    x = [solver.BoolVar(f"x{view}") for view in range(len(visible))]
    for seeing in visible.T:
        views = np.flatnonzero(seeing)
        graph = networkx.from_numpy_array(matchable[np.ix_(views, views)])
        graph.remove_edges_from(list(networkx.selfloop_edges(graph)))
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
