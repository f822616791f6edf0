"""The explanation of a selection in words."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from app.view_selection.explanation import Coverage, Reason
from app.view_selection.selection import Selection

_MAX_NAMES = 3


def describe_selection(selection: Selection) -> str:
    """Several lines: how many views and why so many, what they cover, what was relaxed, and why each view is in."""
    explanation = selection.explanation
    num_selected = len(selection.image_names)
    num_views = num_selected + sum(len(names) for names in selection.not_selected.values())
    lines = [
        f"cluster {selection.cluster}: {num_selected} of {num_views} views selected;"
        f" N_min = {selection.min_views}, {_size(selection)}",
        f"  keypoints that {explanation.n_vis} or more views see: {_covered(explanation.keypoints)}",
        f"  samples that {explanation.n_vis} or more views see: {_covered(explanation.samples)}",
        *(f"  relaxed: {text}" for text in selection.relaxed),
        *(f"  not selected, {len(names)}: {reason}" for reason, names in selection.not_selected.items()),
    ]
    width = max(map(len, selection.image_names), default=0)
    lines += [f"  {name:{width}}  {describe_view(selection, k)}" for k, name in enumerate(selection.image_names)]
    return "\n".join(lines)


def describe_view(selection: Selection, place: int) -> str:
    """What keeps the selected view at a place of ``selection.image_names``."""
    explanation = selection.explanation
    scarce, critical = explanation.scarce_points[place], explanation.critical_points[place]
    held = _listed([selection.image_names[other] for other in explanation.held_views[place]])
    more = " more" if scarce else ""
    texts = {
        Reason.SCARCE: f"needed: one of at most {explanation.n_vis} usable views that see {_points(scarce)}",
        Reason.FORCED: f"forced: among the N_min = {selection.min_views} views that see the most points",
        Reason.COVERS: f"covers {_points(critical - scarce, more)} that fewer than {explanation.n_vis} other selected"
        " views see",
        Reason.MATCHES: f"matching: keeps {held} at N_match = {explanation.n_match}",
        Reason.FILLS: f"fills N_min = {selection.min_views}",
        Reason.UNPROVEN: Reason.UNPROVEN.value,
    }
    words = "; ".join(texts[reason] for reason in explanation.reasons(place))
    if selection.quality == 0:
        return words
    return f"{words}; adds {100 * explanation.added_quality[place] / selection.quality:.1f} % of the quality"


def tabulate_selections(selections: Iterable[Selection]) -> Iterable[str]:
    """The lines of a table with one selection in each."""
    head = f"{'cluster':14}{'views':>7}{'selected':>10}{'N_min':>7}"
    yield f"{head}{'keypoints covered':>22}{'samples covered':>22}  relaxed"
    yield f"{'':{len(head)}}{'before':>14}{'after':>8}{'before':>14}{'after':>8}"
    for selection in selections:
        explanation = selection.explanation
        num_views = len(selection.image_names) + sum(map(len, selection.not_selected.values()))
        shares = "".join(
            f"{percent(coverage.before, coverage):>14}{percent(coverage.after, coverage):>8}"
            for coverage in (explanation.keypoints, explanation.samples)
        )
        yield (
            f"{selection.cluster:14}{num_views:7}{len(selection.image_names):10}{selection.min_views:7}{shares}"
            f"  {'; '.join(selection.relaxed) or '-'}"
        )


def _size(selection: Selection) -> str:
    if selection.size_gap > 0:
        return f"at least {selection.size_bound} are needed; the solver stopped before it knew more"
    return "and no smaller set meets every constraint"


def _covered(coverage: Coverage) -> str:
    return (
        f"{percent(coverage.before, coverage)} of {coverage.total:,} by all views,"
        f" {percent(coverage.after, coverage)} by the selected ones"
    )


def percent(count: int, coverage: Coverage) -> str:
    """Share of a cluster's points; `100.0 %` is all of them."""
    if coverage.total == 0:
        return "-"
    share = 100 * count / coverage.total
    return f"{min(share, 99.9) if count < coverage.total else share:.1f} %"


def _points(count: int, more: str = "") -> str:
    return f"{count:,}{more} point{'' if count == 1 else 's'}"


def _listed(names: Sequence[str]) -> str:
    shown = ", ".join(names[:_MAX_NAMES])
    return shown if len(names) <= _MAX_NAMES else f"{shown} and {len(names) - _MAX_NAMES} more"
