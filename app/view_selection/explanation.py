"""Why each selected view of a cluster is selected, and what the selection covers."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.view_selection.quality import ViewQuality
from app.view_selection.reduction import count_views
from app.view_selection.visibility import pack_rows, unpack_rows

_QUALITY_DIGITS = 2


class Reason(StrEnum):
    """What keeps a selected view, the most compelling first."""

    SCARCE = "sees points that no more than N_vis usable views see"
    FORCED = "forced, as one of the N_min best-seeing views"
    COVERS = "sees points that fewer than N_vis other selected views see"
    MATCHES = "keeps other selected views at N_match matches"
    FILLS = "fills N_min"
    UNPROVEN = "no constraint needs it: the solver stopped before it found a smaller set"


@dataclass(frozen=True, kw_only=True)
class Coverage:
    """How many of a cluster's points at least N_vis views see."""

    total: int
    before: int
    """With all views of the cluster."""
    after: int
    """With the selected views."""


@dataclass(frozen=True, kw_only=True)
class Explanation:
    """What holds each selected view: the constraints that its removal alone would violate.

    The tuples run parallel to the names of the selected views, of which there are n.
    """

    n_vis: int
    n_match: int
    """As relaxed."""
    keypoints: Coverage
    samples: Coverage
    forced: tuple[bool, ...]
    """(n,) selected for being among the N_min best-seeing views."""
    scarce_points: tuple[int, ...]
    """(n,) points that the view sees and no more than N_vis usable views see: every feasible selection has the view."""
    critical_points: tuple[int, ...]
    """(n,) points that the view sees and fewer than N_vis other selected views see; the scarce ones are among them."""
    held_views: tuple[tuple[int, ...], ...]
    """(n, any) places of the selected views that match just N_match selected views, this one among them."""
    fills_min_views: bool
    """No more than N_min views are selected, so none of them can go."""
    added_quality: tuple[float, ...]
    """(n,) how much total quality the selection would lose without the view; 0 where the method doesn't ask for it."""

    def reasons(self, place: int) -> tuple[Reason, ...]:
        """All that keeps the selected view at a place; FILLS only where nothing else does."""
        critical, scarce = self.critical_points[place], self.scarce_points[place]
        holding = {
            Reason.SCARCE: scarce > 0,
            Reason.FORCED: self.forced[place],
            Reason.COVERS: critical > scarce,
            Reason.MATCHES: bool(self.held_views[place]),
        }
        found = tuple(reason for reason, holds in holding.items() if holds)
        return found or (Reason.FILLS if self.fills_min_views else Reason.UNPROVEN,)

    @classmethod
    def from_record(cls, record: dict[str, Any]) -> Explanation:
        """The inverse of ``dataclasses.asdict``, also after JSON.

        Raises:
            KeyError, TypeError: it isn't one.
        """
        lists = ("forced", "scarce_points", "critical_points", "added_quality")
        changed = {name: tuple(record[name]) for name in lists}
        changed["held_views"] = tuple(tuple(views) for views in record["held_views"])
        coverage = {name: Coverage(**record[name]) for name in ("keypoints", "samples")}
        return cls(**{**record, **changed, **coverage})


@dataclass(frozen=True)
class ExplanationSums:
    """Sums over clusters. A point in the overlap of several clusters counts in each."""

    keypoints: Counter[str] = field(default_factory=Counter)
    samples: Counter[str] = field(default_factory=Counter)
    reasons: Counter[Reason] = field(default_factory=Counter)
    """How many selected views have each as their most compelling reason."""

    def add(self, explanation: Explanation) -> None:
        """Add one cluster."""
        self.keypoints.update(asdict(explanation.keypoints))
        self.samples.update(asdict(explanation.samples))
        self.reasons.update(explanation.reasons(place)[0] for place in range(len(explanation.forced)))

    def record(self) -> dict[str, Any]:
        """For a report."""
        return {
            "keypoints_seen_by_n_vis": dict(self.keypoints),
            "samples_seen_by_n_vis": dict(self.samples),
            "selected_images_by_reason": {reason: self.reasons[reason] for reason in Reason},
        }


def explain_selection(
    *,
    selected: NDArray[np.bool_],
    visible: NDArray[np.uint64],
    num_keypoints: int,
    usable: NDArray[np.bool_],
    forced: NDArray[np.bool_],
    matches: NDArray[np.bool_],
    n_vis: int,
    n_match: int,
    min_views: int,
    worth: ViewQuality | None = None,
) -> Explanation:
    """Find what keeps each view of a feasible selection.

    Args:
        selected: (N_c,) a selection that meets every constraint.
        visible: (P_c, words) views that see each point, packed; the keypoints first.
        num_keypoints: How many of the points are keypoints.
        usable: (N_c,) views that may be selected. A point that fewer than N_vis of them see needs all of those.
        forced: (N_c,) views that are selected for being the best-seeing.
        matches: (N_c, N_c) S~ of [O].
        n_vis: N_vis.
        n_match: N_match.
        min_views: N_min.
        worth: Where selections are compared by quality.
    """
    views = np.flatnonzero(selected)
    packed_selected, packed_usable = pack_rows(np.stack([selected, usable]))
    num_selected_seeing = count_views(visible & packed_selected)
    critical = (num_selected_seeing > 0) & (num_selected_seeing <= n_vis)
    scarce = count_views(visible[critical] & packed_usable) <= n_vis
    seen = unpack_rows(visible[critical] & packed_selected, len(selected))[:, views]
    among = matches[np.ix_(views, views)]
    held_views: list[list[int]] = [[] for _ in views]
    for place, other in np.argwhere(among & (among.sum(axis=0) <= n_match)).tolist():
        held_views[place].append(other)
    covered = np.stack([count_views(visible) >= n_vis, num_selected_seeing >= n_vis])
    return Explanation(
        n_vis=n_vis,
        n_match=n_match,
        keypoints=_coverage(covered[:, :num_keypoints]),
        samples=_coverage(covered[:, num_keypoints:]),
        forced=tuple(forced[views].tolist()),
        scarce_points=tuple(seen[scarce].sum(axis=0).tolist()),
        critical_points=tuple(seen.sum(axis=0).tolist()),
        held_views=tuple(map(tuple, held_views)),
        fills_min_views=len(views) <= min_views,
        added_quality=(0.0,) * len(views) if worth is None else _added_quality(views, worth),
    )


def _coverage(covered: NDArray[np.bool_]) -> Coverage:
    before, after = covered.sum(axis=1).tolist()
    return Coverage(total=covered.shape[1], before=before, after=after)


def _added_quality(views: NDArray[np.int64], worth: ViewQuality) -> tuple[float, ...]:
    """What the total over viewpoints of the best selected view's quality loses without each view."""
    quality, viewpoint = worth.quality[views], worth.viewpoint[views]
    best_first = np.lexsort((-quality, viewpoint))
    ordered = quality[best_first]
    changes = np.diff(viewpoint[best_first], prepend=-1, append=-1) != 0
    is_best, has_second = changes[:-1], ~changes[1:]
    added = np.empty(len(views))
    added[best_first] = np.where(is_best, ordered - np.where(has_second, np.append(ordered[1:], 0.0), 0.0), 0.0)
    return tuple(np.round(added, _QUALITY_DIGITS).tolist())
