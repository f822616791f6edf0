"""View selection as [O] section 4 describes it: one constraint per point, no reduction, SCIP through OR-Tools.

Where [O] is silent, the decisions are those of the program (its options say why), reached by other code.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from ortools.linear_solver import pywraplp

from app.clustering.options import ClusteringOptions
from app.scene.posed_scene import PosedScene
from app.view_selection.options import SelectionOptions
from benchmarks.reference.clustering import PlainCluster, inside, padded_bounds, samples, sees


@dataclass(frozen=True, kw_only=True)
class PlainProgram:
    """The integer program of a cluster with N_c views and P_c points."""

    images: tuple[int, ...]
    """Rows of the scene, one a view."""
    keypoints: tuple[int, ...]
    """Rows of the scene; the first of the points. In the order of their positions."""
    visible: NDArray[np.bool_]
    """(N_c, P_c) the matrix B."""
    matches: NDArray[np.bool_]
    """(N_c, N_c) the matrix S~ with a false diagonal."""
    usable: NDArray[np.bool_]
    """(N_c,) views with enough matches among each other; the others can't be selected."""
    n_vis: int
    n_match: int
    n_min: int


def plain_program(
    scene: PosedScene, cluster: PlainCluster, clustering: ClusteringOptions, options: SelectionOptions
) -> PlainProgram:
    """Project every point of a cluster into every image of it, and count what each pair has in common."""
    images = tuple(sorted(cluster.images))
    bounds = [padded_bounds(cell, clustering) for cell in cluster.cells]
    found = np.flatnonzero(np.any([inside(scene, low, high) for low, high in bounds], axis=0))
    keypoints = tuple(sorted(found.tolist(), key=lambda row: tuple(scene.points_in_world[row])))
    block_samples = [samples(low, high, cluster.z_range, clustering) for low, high in bounds]
    points = np.concatenate([scene.points_in_world[list(keypoints)], *block_samples])
    visible = np.array([sees(scene, image, points) for image in images])
    shared = visible.astype(np.float32) @ visible.astype(np.float32).T
    matches = shared >= options.min_shared_points
    np.fill_diagonal(matches, False)
    usable, n_match = _usable(matches, options.n_match)
    wanted = min(max(math.ceil(options.min_views_fraction * len(images)), options.n_low), options.n_high)
    return PlainProgram(
        images=images,
        keypoints=keypoints,
        visible=visible,
        matches=matches,
        usable=usable,
        n_vis=options.n_vis,
        n_match=n_match,
        n_min=min(wanted, int(usable.sum())),
    )


def solve(program: PlainProgram, *, force_best_views: bool) -> frozenset[int]:
    """Images of a smallest set of views that meets every constraint.

    Args:
        program: All of it goes to the solver.
        force_best_views: Whether the N_min best-seeing views are selected in any case, as [O] does.

    Raises:
        RuntimeError: SCIP didn't prove that the set is the smallest.
    """
    solver, x = _model(program)
    if force_best_views:
        # A stable sort: of views that see equally much, the first by name.
        best_first = sorted(np.flatnonzero(program.usable), key=lambda view: -int(program.visible[view].sum()))
        for view in best_first[: program.n_min]:
            x[view].SetLb(1)
    solver.Minimize(solver.Sum(x))
    _solve(solver)
    return frozenset(
        image for image, variable in zip(program.images, x, strict=True) if variable.solution_value() > 0.5
    )


def best_quality(program: PlainProgram, quality: NDArray[np.float64], viewpoint: NDArray[np.int64], size: int) -> float:
    """The best total quality of a selection of a size: the sum over viewpoints of its best view there.

    Beyond [O]: what the program's `optimal` selection asks for.

    Args:
        program: All of it goes to the solver.
        quality: (N_c,) from :func:`benchmarks.reference.quality.plain_quality`.
        viewpoint: (N_c,) likewise.
        size: Number of views.

    Raises:
        RuntimeError: SCIP didn't prove that it is the best.
    """
    solver, x = _model(program)
    solver.Add(solver.Sum(x) == size)
    counts = [solver.NumVar(0, 1, f"counts{view}") for view in range(len(x))]
    for view, counting in enumerate(counts):
        solver.Add(counting <= x[view])
    for number in np.unique(viewpoint):
        solver.Add(solver.Sum([counts[view] for view in np.flatnonzero(viewpoint == number)]) <= 1)
    solver.Maximize(solver.Sum([float(value) * counting for value, counting in zip(quality, counts, strict=True)]))
    _solve(solver)
    return float(solver.Objective().Value())


def _model(program: PlainProgram) -> tuple[pywraplp.Solver, list[pywraplp.Variable]]:
    """The constraints of [O], one per view and one per point."""
    solver = pywraplp.Solver.CreateSolver("SCIP")
    x = [solver.IntVar(0, int(can), f"x{view}") for view, can in enumerate(program.usable)]
    enough = solver.Constraint(program.n_min, solver.infinity())
    for variable in x:
        enough.SetCoefficient(variable, 1)
    for view in np.flatnonzero(program.usable):
        matchable = solver.Constraint(0, solver.infinity())
        for other in np.flatnonzero(program.matches[view] & program.usable):
            matchable.SetCoefficient(x[other], 1)
        matchable.SetCoefficient(x[view], -program.n_match)
    for seeing in program.visible.T:
        views = np.flatnonzero(seeing & program.usable)
        covered = solver.Constraint(min(program.n_vis, len(views)), solver.infinity())
        for view in views:
            covered.SetCoefficient(x[view], 1)
    return solver, x


def _solve(solver: pywraplp.Solver) -> None:
    if solver.Solve() != pywraplp.Solver.OPTIMAL:
        raise RuntimeError("SCIP found no proven optimum")


def meets_all(program: PlainProgram, images: frozenset[int]) -> bool:
    """Whether a selection meets every constraint of a program."""
    x = np.array([image in images for image in program.images], dtype=np.int64)
    seen_by = program.visible[program.usable].sum(axis=0)
    return bool(
        len(images) == x.sum() >= program.n_min
        and not np.any(x[~program.usable])
        and np.all(program.matches @ x - program.n_match * x >= 0)
        and np.all(program.visible.T.astype(np.int64) @ x >= np.minimum(program.n_vis, seen_by))
    )


def _usable(matches: NDArray[np.bool_], n_match: int) -> tuple[NDArray[np.bool_], int]:
    """Views that can have ``n_match`` matches among each other, for the greatest ``n_match`` that leaves any."""
    for n in range(n_match, 0, -1):
        usable = np.ones(len(matches), dtype=np.bool_)
        while np.any(usable & (matches[:, usable].sum(axis=1) < n)):
            usable &= matches[:, usable].sum(axis=1) >= n
        if usable.any():
            return usable, n
    return np.zeros(len(matches), dtype=np.bool_), 0
