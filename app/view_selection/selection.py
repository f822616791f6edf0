"""The views of a cluster that dense stereo needs, why the others aren't needed, and the file that keeps them."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from app.errors import InputError
from app.view_selection.explanation import Explanation, explain_selection
from app.view_selection.ilp import Solution, ViewProgram, best_selection, smallest_selection
from app.view_selection.options import SelectionMethod, SelectionOptions
from app.view_selection.problem import ViewProblem
from app.view_selection.quality import view_quality
from app.view_selection.reduction import CoveringRows, covering_rows, reduce_rows, required_views
from app.view_selection.visibility import matching_views, pack_rows, unpack_rows, visible_points

FILE_NAME = "selection.jsonl"
FORMAT_VERSION = 2


@dataclass(frozen=True, kw_only=True)
class Selection:
    """The selected views of one cluster."""

    cluster: str
    image_names: tuple[str, ...]
    """Selected, sorted. Empty where no two views match: then nothing can be reconstructed."""
    not_selected: dict[str, tuple[str, ...]]
    """The other views, sorted, by the reason why they aren't selected."""
    relaxed: tuple[str, ...]
    """What the model had to give up so that a selection exists."""
    num_points: int
    """P_c, keypoints and samples."""
    num_rows: int
    """Distinct visibility constraints that were left for the solver."""
    min_views: int
    """N_min."""
    size_bound: int
    """No selection that meets the constraints has fewer views."""
    explanation: Explanation
    """What keeps each selected view, and what they cover."""
    quality: float = 0.0
    """Total view quality; 0 where the method doesn't ask for it."""
    quality_bound: float = 0.0
    """No selection of this size has more."""

    @property
    def size_gap(self) -> float:
        """Share of the selected views that a better solution might save; 0 where the size is proven the smallest."""
        return 1 - self.size_bound / len(self.image_names) if self.image_names else 0.0

    @property
    def quality_gap(self) -> float:
        """Share of quality that a better solution of this size might add; 0 where it is proven the best."""
        return self.quality_bound / self.quality - 1 if self.quality else 0.0


def select_views(problem: ViewProblem, options: SelectionOptions) -> Selection:
    """Select the smallest set of views that sees and matches everything, [O] section 4.

    The model has a solution whatever the input: a point that fewer than N_vis usable views see needs only those, a view
    that fewer than N_match usable views match can't be selected, and N_match falls where that would leave no view. The
    result doesn't depend on the order of views and points.

    Args:
        problem: Views and points of a cluster.
        options: The paper's parameters, and the method.
    """
    num_views = len(problem.image_names)
    visible = visible_points(problem, options.visibility)
    matches = matching_views(visible, options.min_shared_points)
    usable, n_match = _usable_views(matches, options.n_match)
    rows, num_seen_by = covering_rows(visible.by_point, pack_rows(usable[None])[0], options.n_vis)
    wanted = options.min_views(num_views)
    relaxed = _relaxations(num_seen_by, n_match, wanted, int(usable.sum()), options)
    min_views = min(wanted, int(usable.sum()))

    forced = _forced_views(visible.num_seen, usable, min_views, options)
    program = _program(rows, matches, usable, n_match, min_views, forced)
    worth = None
    if options.method is SelectionMethod.PAPER:
        solution = smallest_selection(program, visible.num_seen.astype(np.float64), options.max_solver_nodes)
    else:
        worth = view_quality(problem, visible)
        solution = smallest_selection(program, worth.quality, options.max_solver_nodes)
        solution = best_selection(program, solution, worth, options.max_solver_nodes)
    explanation = explain_selection(
        selected=solution.selected,
        visible=visible.by_point,
        num_keypoints=len(problem.keypoints_in_world),
        usable=usable,
        forced=forced,
        matches=matches,
        n_vis=options.n_vis,
        n_match=n_match,
        min_views=min_views,
        worth=worth,
    )
    return _selection(problem, program, solution, relaxed, explanation, num_points=len(visible.by_point))


def _usable_views(matches: NDArray[np.bool_], n_match: int) -> tuple[NDArray[np.bool_], int]:
    """Views that match ``n_match`` other usable views each, and the greatest ``n_match`` that leaves any."""
    while n_match > 0:
        usable = np.ones(len(matches), dtype=np.bool_)
        while True:
            still = usable & (matches @ usable.astype(np.int64) >= n_match)
            if np.array_equal(still, usable):
                break
            usable = still
        if usable.any():
            return usable, n_match
        n_match -= 1
    return np.zeros(len(matches), dtype=np.bool_), 0


def _forced_views(
    num_seen: NDArray[np.int64], usable: NDArray[np.bool_], min_views: int, options: SelectionOptions
) -> NDArray[np.bool_]:
    """The N_min best-seeing views where the method is the paper's, otherwise none."""
    forced = np.zeros(len(usable), dtype=np.bool_)
    if options.method is SelectionMethod.PAPER:
        best_first = np.lexsort((np.arange(len(usable)), -num_seen, ~usable))
        forced[best_first[:min_views]] = True
    return forced


def _program(
    rows: CoveringRows,
    matches: NDArray[np.bool_],
    usable: NDArray[np.bool_],
    n_match: int,
    min_views: int,
    forced: NDArray[np.bool_],
) -> ViewProgram:
    fixed = pack_rows(forced[None])[0] | required_views(rows)
    return ViewProgram(
        rows=reduce_rows(rows, fixed),
        matches=matches,
        usable=usable,
        fixed=unpack_rows(fixed[None], len(usable))[0],
        n_match=n_match,
        min_views=min_views,
    )


def _relaxations(
    num_seen_by: NDArray[np.int64], n_match: int, wanted: int, num_usable: int, options: SelectionOptions
) -> tuple[str, ...]:
    relaxed = [
        f"{count} of the points seen by {number} instead of {options.n_vis} usable views"
        for number, count in enumerate(num_seen_by)
        if count
    ]
    if n_match < options.n_match:
        relaxed.append(f"views match {n_match} others instead of {options.n_match}: no set of views has more")
    if num_usable < wanted:
        relaxed.append(f"{num_usable} usable views instead of N_min = {wanted}")
    return tuple(relaxed)


def _selection(
    problem: ViewProblem,
    program: ViewProgram,
    solution: Solution,
    relaxed: tuple[str, ...],
    explanation: Explanation,
    *,
    num_points: int,
) -> Selection:
    reasons = {
        f"matches fewer than {max(program.n_match, 1)} usable views": ~program.usable,
        "not needed: the selected views meet every constraint without it": program.usable & ~solution.selected,
    }
    return Selection(
        cluster=problem.cluster,
        image_names=_names(problem, solution.selected),
        not_selected={reason: _names(problem, views) for reason, views in reasons.items() if views.any()},
        relaxed=relaxed,
        num_points=num_points,
        num_rows=len(program.rows.bounds),
        min_views=program.min_views,
        size_bound=solution.size_bound,
        explanation=explanation,
        quality=solution.quality,
        quality_bound=solution.quality_bound,
    )


def _names(problem: ViewProblem, views: NDArray[np.bool_]) -> tuple[str, ...]:
    return tuple(problem.image_names[view] for view in np.flatnonzero(views))


def write_selections(selections: Iterable[Selection], folder: Path) -> None:
    """Write one JSON line per cluster, as they come."""
    with (folder / FILE_NAME).open("w", encoding="utf-8") as file:
        for selection in selections:
            file.write(json.dumps(vars(selection), default=vars) + "\n")


def read_selections(folder: Path) -> Iterator[Selection]:
    """Read what :func:`write_selections` wrote, one at a time.

    Raises:
        InputError: absent or damaged.
    """
    path = folder / FILE_NAME
    try:
        with path.open(encoding="utf-8") as file:
            for line in file:
                record = json.loads(line)
                for name in ("image_names", "relaxed"):
                    record[name] = tuple(record[name])
                record["not_selected"] = {why: tuple(names) for why, names in record["not_selected"].items()}
                record["explanation"] = Explanation.from_record(record["explanation"])
                yield Selection(**record)
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}; run `cityrecon select` first") from error
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path} is damaged; remove its folder and run `cityrecon select` again") from error
