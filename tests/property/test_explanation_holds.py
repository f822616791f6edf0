"""What the explanation says of each selected view, against the constraints that break when that view is dropped."""

from __future__ import annotations

import itertools
import json
from dataclasses import asdict

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from app.clustering.clusters import cluster_views
from app.clustering.options import ClusteringOptions
from app.view_selection.explanation import Explanation, Reason, explain_selection
from app.view_selection.ilp import ViewProgram, smallest_selection, total_quality
from app.view_selection.options import SelectionMethod, SelectionOptions, Visibility
from app.view_selection.problem import ProblemCutter
from app.view_selection.quality import ViewQuality
from app.view_selection.reduction import covering_rows
from app.view_selection.selection import select_views
from app.view_selection.visibility import pack_rows
from tests.reference import visibility as plain
from tests.reference.posed_scenes import random_scene

few = settings(max_examples=12, derandomize=True, deadline=None)
many = settings(max_examples=60, derandomize=True, deadline=None)


class Case:
    """A random cluster in plain arrays, a selection that meets its constraints, and its explanation."""

    def __init__(self, seed: int, num_views: int, n_vis: int, n_match: int, spare: bool) -> None:
        rng = np.random.default_rng(seed)
        self.n_vis, self.n_match = n_vis, n_match
        self.visible = rng.random((12, num_views)) < rng.uniform(0.2, 0.9, (12, 1))
        self.num_keypoints = int(rng.integers(0, 13))
        matches = np.triu(rng.random((num_views, num_views)) < rng.uniform(0.3, 0.9), 1)
        self.matches = matches | matches.T
        self.usable = rng.random(num_views) < 0.9
        for _ in range(num_views):
            self.usable &= (self.matches @ self.usable) >= n_match
        self.bounds = np.minimum((self.visible & self.usable).sum(axis=1), n_vis)
        self.forced = self.usable & (rng.random(num_views) < 0.15)
        self.min_views = int(rng.integers(0, self.usable.sum() + 1))
        self.worth = ViewQuality(quality=rng.integers(0, 5, num_views) * 1.5, viewpoint=rng.integers(0, 4, num_views))
        rows, _ = covering_rows(pack_rows(self.visible), pack_rows(self.usable[None])[0], n_vis)
        program = ViewProgram(
            rows=rows,
            matches=self.matches,
            usable=self.usable,
            fixed=self.forced,
            n_match=n_match,
            min_views=self.min_views,
        )
        self.selected = smallest_selection(program, self.worth.quality, 1000).selected
        if spare:
            more = self.selected | (self.usable & (rng.random(num_views) < 0.3))
            if not self.broken(more):
                self.selected = more
        self.explanation = explain_selection(
            selected=self.selected,
            visible=pack_rows(self.visible),
            num_keypoints=self.num_keypoints,
            usable=self.usable,
            forced=self.forced,
            matches=self.matches,
            n_vis=n_vis,
            n_match=n_match,
            min_views=self.min_views,
            worth=self.worth,
        )

    def broken(self, selected: np.ndarray) -> set[tuple[str, int]]:
        """The constraints of [O] section 4 that a selection doesn't meet, one by one."""
        found = {("point", p) for p, row in enumerate(self.visible) if (row & selected).sum() < self.bounds[p]}
        found |= {("match", i) for i in np.flatnonzero(selected) if (self.matches[i] & selected).sum() < self.n_match}
        if selected.sum() < self.min_views:
            found.add(("size", 0))
        return found


cases = st.builds(Case, st.integers(0, 10_000), st.integers(1, 10), st.integers(1, 3), st.integers(1, 3), st.booleans())


@many
@given(cases)
def test_a_view_is_held_by_exactly_the_constraints_that_break_without_it(case: Case) -> None:
    assert not case.broken(case.selected)
    explanation, views = case.explanation, np.flatnonzero(case.selected)
    for place, view in enumerate(views):
        without = case.selected.copy()
        without[view] = False
        broken = case.broken(without)
        assert explanation.critical_points[place] == sum(kind == "point" for kind, _ in broken)
        held = {int(views[other]) for other in explanation.held_views[place]}
        assert held == {other for kind, other in broken if kind == "match"}
        assert explanation.fills_min_views == (("size", 0) in broken)
        reasons = explanation.reasons(place)
        assert (Reason.UNPROVEN in reasons) == (not broken and not case.forced[view])
        assert (Reason.FILLS in reasons) == (broken == {("size", 0)} and not case.forced[view])
        assert explanation.forced[place] == case.forced[view]
        lost = total_quality(case.selected, case.worth) - total_quality(without, case.worth)
        assert explanation.added_quality[place] == pytest.approx(lost)


@many
@given(cases)
def test_a_scarce_point_has_its_view_in_every_feasible_selection(case: Case) -> None:
    subsets = np.array(list(itertools.product([False, True], repeat=len(case.usable))), dtype=bool)
    feasible = [s for s in subsets if not (s & ~case.usable).any() and not case.broken(s)]
    counts = (case.visible & case.usable).sum(axis=1)
    for place, view in enumerate(np.flatnonzero(case.selected)):
        scarce = int((case.visible[:, view] & (counts <= case.n_vis)).sum())
        assert case.explanation.scarce_points[place] == scarce <= case.explanation.critical_points[place]
        assert not scarce or all(subset[view] for subset in feasible)


@many
@given(cases)
def test_coverage_is_a_plain_count(case: Case) -> None:
    for coverage, rows in (
        (case.explanation.keypoints, case.visible[: case.num_keypoints]),
        (case.explanation.samples, case.visible[case.num_keypoints :]),
    ):
        assert coverage.total == len(rows)
        assert coverage.before == sum(row.sum() >= case.n_vis for row in rows)
        assert coverage.after == sum((row & case.selected).sum() >= case.n_vis for row in rows)


@many
@given(cases)
def test_an_explanation_comes_back_from_json(case: Case) -> None:
    assert Explanation.from_record(json.loads(json.dumps(asdict(case.explanation)))) == case.explanation


@few
@given(st.integers(0, 10_000), st.sampled_from(list(SelectionMethod)))
def test_selections_of_scenes_are_explained_by_what_their_views_see(seed: int, method: SelectionMethod) -> None:
    scene = random_scene(seed, num_images=20)
    clustering = cluster_views(scene, ClusteringOptions(sample_spacing_m=4.0, min_cameras_per_cluster=3))
    cutter = ProblemCutter(scene)
    for cluster in clustering.clusters[:3]:
        problem = cutter.problem(cluster, Visibility.FRUSTUM)
        found = select_views(problem, SelectionOptions(method=method, n_low=3, n_high=6, min_shared_points=3))
        explanation = found.explanation
        selected = np.isin(problem.image_names, found.image_names)
        points = np.concatenate([problem.keypoints_in_world, problem.samples_in_world])
        seen = plain.visibility_matrix(points, problem.image_from_world, problem.sizes_px)
        num_keypoints = len(problem.keypoints_in_world)
        for coverage, rows in (
            (explanation.keypoints, seen[:num_keypoints]),
            (explanation.samples, seen[num_keypoints:]),
        ):
            assert coverage.total == len(rows)
            assert coverage.before == (rows.sum(axis=1) >= 2).sum()
            assert coverage.after == (rows[:, selected].sum(axis=1) >= 2).sum()
        unmatched = [names for reason, names in found.not_selected.items() if reason.startswith("matches fewer")]
        usable = ~np.isin(problem.image_names, [name for names in unmatched for name in names])
        num_usable = seen[:, usable].sum(axis=1)
        bounds = np.minimum(num_usable, 2)
        matches = plain.share_at_least([set(np.flatnonzero(column).tolist()) for column in seen.T], 3)
        for place, view in enumerate(np.flatnonzero(selected)):
            without = selected & (np.arange(len(selected)) != view)
            missing = seen[:, without].sum(axis=1) < bounds
            assert explanation.critical_points[place] == missing.sum()
            assert explanation.scarce_points[place] == (missing & (num_usable <= 2)).sum()
            lonely = without & ((matches & without).sum(axis=1) < explanation.n_match)
            held = [found.image_names[other] for other in explanation.held_views[place]]
            assert held == [problem.image_names[other] for other in np.flatnonzero(lonely)]
        reasons = [explanation.reasons(place) for place in range(len(found.image_names))]
        assert not any(Reason.UNPROVEN in held for held in reasons)
        num_forced = sum(Reason.FORCED in held for held in reasons)
        assert num_forced == (found.min_views if method is SelectionMethod.PAPER else 0)
