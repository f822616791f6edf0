"""The integer linear program of [O] section 4, over packed and reduced constraints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from ortools.sat.python import cp_model

from app.view_selection.reduction import CoveringRows
from app.view_selection.visibility import unpack_rows

_QUALITY_STEPS = 10_000
"""The solver works on whole numbers: the best view's quality is this many steps."""


@dataclass(frozen=True, kw_only=True)
class ViewProgram:
    """min sum x, so that the covering rows, the matching and the minimum number of views hold. It has a solution."""

    rows: CoveringRows
    """Covering rows over the views that aren't fixed."""
    matches: NDArray[np.bool_]
    """(N_c, N_c) S~."""
    usable: NDArray[np.bool_]
    """(N_c,) views that may be selected; each matches at least ``n_match`` others of them."""
    fixed: NDArray[np.bool_]
    """(N_c,) views that are selected in any case."""
    n_match: int
    min_views: int
    """N_min; at most the number of usable views."""

    def missing(self, selected: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """How many views each covering row lacks (R,), and how many matches each selected view lacks (N_c,)."""
        covered = unpack_rows(self.rows.bits, len(selected)) @ selected.astype(np.int64)
        matched = self.matches @ selected.astype(np.int64)
        return np.maximum(self.rows.bounds - covered, 0), np.where(selected, np.maximum(self.n_match - matched, 0), 0)

    def is_met_by(self, selected: NDArray[np.bool_]) -> bool:
        """Whether a selection meets every constraint."""
        uncovered, unmatched = self.missing(selected)
        allowed = not np.any(selected & ~self.usable) and bool(np.all(selected[self.fixed]))
        return allowed and selected.sum() >= self.min_views and not uncovered.any() and not unmatched.any()


@dataclass(frozen=True, kw_only=True)
class Solution:
    """A feasible selection and what is proven about it."""

    selected: NDArray[np.bool_]
    """(N_c,)"""
    size_bound: int
    """No feasible selection has fewer views."""
    quality: int = 0
    """Total quality in whole steps; 0 where none was asked for."""
    quality_bound: int = 0
    """No feasible selection of this size has more."""


def greedy_selection(program: ViewProgram, preference: NDArray[np.float64]) -> NDArray[np.bool_]:
    """A feasible selection without a solver: cover, match, fill up, then drop what isn't needed.

    Args:
        program: What to meet.
        preference: (N_c,) which views to take where several help equally.

    Returns:
        (N_c,)
    """
    views_of_row = unpack_rows(program.rows.bits, len(program.usable))
    order = np.lexsort((np.arange(len(preference)), -preference))
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    selected = program.fixed.copy()
    while True:
        uncovered, unmatched = program.missing(selected)
        if uncovered.any():
            gain = views_of_row[uncovered > 0].sum(axis=0)
        elif unmatched.any():
            gain = program.matches[unmatched > 0].sum(axis=0)
        elif selected.sum() < program.min_views:
            gain = np.ones(len(selected), dtype=np.int64)
        else:
            break
        gain = np.where(program.usable & ~selected, gain, 0)
        selected[np.lexsort((rank, -gain))[0]] = True
    for view in order[::-1]:
        if selected.sum() <= program.min_views:
            break
        if selected[view] and not program.fixed[view]:
            selected[view] = False
            selected[view] = not program.is_met_by(selected)
    return selected


def smallest_selection(program: ViewProgram, preference: NDArray[np.float64], max_time_s: float) -> Solution:
    """Solve the program of [O]; the greedy selection where the solver finds nothing better in time."""
    selected = greedy_selection(program, preference)
    bound = max(program.min_views, int(program.fixed.sum()))
    if selected.sum() > bound:
        model, variables = _model(program, selected)
        model.minimize(cp_model.LinearExpr.sum(variables))
        solver, found = _solve(model, variables, max_time_s)
        bound = max(bound, _whole_bound(solver.best_objective_bound))
        if found is not None and found.sum() < selected.sum():
            selected = found
    return Solution(selected=selected, size_bound=bound)


def best_selection(
    program: ViewProgram,
    smallest: Solution,
    quality: NDArray[np.float64],
    viewpoint: NDArray[np.int64],
    max_time_s: float,
) -> Solution:
    """Among the feasible selections of the smallest size, the one with the best total quality.

    The total is the sum over viewpoints of the quality of the best selected view there: a second view from the same
    place adds no parallax.

    Args:
        program: What to meet.
        smallest: A selection of the size wanted.
        quality: (N_c,)
        viewpoint: (N_c,) number of each view's viewpoint.
        max_time_s: Of the solver, deterministic.
    """
    steps = np.round(quality * (_QUALITY_STEPS / max(quality.max(initial=0.0), 1e-300))).astype(np.int64)
    model, variables = _model(program, smallest.selected)
    model.add(cp_model.LinearExpr.sum(variables) == int(smallest.selected.sum()))
    # A view alone at its viewpoint counts itself; of several, one counts.
    counted = list(variables)
    for number in np.unique(viewpoint[program.usable]):
        views = np.flatnonzero((viewpoint == number) & program.usable)
        if len(views) < 2:
            continue
        for view in views.tolist():
            counted[view] = model.new_bool_var(f"counts_{view}")
            model.add_implication(counted[view], variables[view])
        model.add_at_most_one([counted[view] for view in views])
    model.maximize(cp_model.LinearExpr.weighted_sum(counted, [int(step) for step in steps]))
    solver, found = _solve(model, variables, max_time_s)
    selected = smallest.selected if found is None else found
    total = total_quality(selected, steps, viewpoint)
    return Solution(
        selected=selected,
        size_bound=smallest.size_bound,
        quality=total,
        quality_bound=max(total, -_whole_bound(-solver.best_objective_bound)),
    )


def total_quality(selected: NDArray[np.bool_], quality: NDArray[np.int64], viewpoint: NDArray[np.int64]) -> int:
    """Sum over viewpoints of the best selected view's quality."""
    best = np.zeros(int(viewpoint.max(initial=-1)) + 1, dtype=np.int64)
    np.maximum.at(best, viewpoint[selected], quality[selected])
    return int(best.sum())


def _whole_bound(bound: float) -> int:
    """The whole number that a proven lower bound of a whole number implies; the solver's bounds are nearly whole."""
    return int(np.ceil(bound - 1e-6))


def _model(program: ViewProgram, hint: NDArray[np.bool_]) -> tuple[cp_model.CpModel, list[cp_model.IntVar]]:
    """The program's constraints, without an objective."""
    model = cp_model.CpModel()
    variables = [model.new_bool_var(f"view_{view}") for view in range(len(hint))]
    for view, variable in enumerate(variables):
        model.add_hint(variable, bool(hint[view]))
        if not program.usable[view]:
            model.add(variable == 0)
        elif program.fixed[view]:
            model.add(variable == 1)
    model.add(cp_model.LinearExpr.sum(variables) >= program.min_views)
    for row, bound in zip(unpack_rows(program.rows.bits, len(hint)), program.rows.bounds, strict=True):
        model.add(cp_model.LinearExpr.sum([variables[view] for view in np.flatnonzero(row)]) >= int(bound))
    num_usable = int(program.usable.sum())
    for view in np.flatnonzero(program.usable).tolist():
        partners = np.flatnonzero(program.matches[view] & program.usable).tolist()
        # With so few views that don't match, any selection of N_min views has enough that do.
        if program.min_views - 1 - (num_usable - 1 - len(partners)) >= program.n_match:
            continue
        matched = cp_model.LinearExpr.sum([variables[partner] for partner in partners])
        model.add(matched >= program.n_match * variables[view])
    return model, variables


def _solve(
    model: cp_model.CpModel, variables: list[cp_model.IntVar], max_time_s: float
) -> tuple[cp_model.CpSolver, NDArray[np.bool_] | None]:
    """Run the solver so that the same model gives the same result on every machine."""
    solver = cp_model.CpSolver()
    solver.parameters.num_workers = 1
    solver.parameters.random_seed = 0
    solver.parameters.max_deterministic_time = max_time_s
    status = solver.solve(model)
    if status not in (cp_model.OPTIMAL, cp_model.FEASIBLE):
        return solver, None
    return solver, np.array([solver.boolean_value(variable) for variable in variables], dtype=np.bool_)
