"""What must hold for the selected views of any cluster, against all subsets where there are few views."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from app.clustering.clusters import cluster_views
from app.clustering.options import ClusteringOptions
from app.view_selection import ilp
from app.view_selection.ilp import (
    ViewProgram,
    best_selection,
    greedy_selection,
    smallest_selection,
    total_quality,
)
from app.view_selection.options import SelectionMethod, SelectionOptions, Visibility
from app.view_selection.problem import ProblemCutter, ViewProblem
from app.view_selection.quality import ViewQuality, view_quality
from app.view_selection.reduction import CoveringRows, covering_rows, reduce_rows, required_views
from app.view_selection.selection import select_views
from app.view_selection.visibility import pack_rows, unpack_rows, visible_points
from tests.reference import visibility as plain
from tests.reference.posed_scenes import random_scene, shuffled

few = settings(max_examples=12, derandomize=True, deadline=None)
many = settings(max_examples=40, derandomize=True, deadline=None)
seeds = st.integers(0, 10_000)
methods = st.sampled_from(list(SelectionMethod))
visibilities = st.sampled_from(list(Visibility))
of_reference = st.sampled_from([Visibility.FRUSTUM, Visibility.TRACKS])


def _subsets(num_views: int) -> np.ndarray:
    """(2^N, N) all selections."""
    return np.array(list(itertools.product([False, True], repeat=num_views)), dtype=bool)


def _random_program(seed: int, num_views: int) -> tuple[ViewProgram, np.ndarray]:
    """A program that has a solution, not reduced, and the visibility matrix (P, N) behind its rows."""
    rng = np.random.default_rng(seed)
    visible = rng.random((30, num_views)) < rng.uniform(0.1, 0.8, (30, 1))
    matches = np.triu(rng.random((num_views, num_views)) < rng.uniform(0.2, 0.9), 1)
    matches |= matches.T
    usable = np.ones(num_views, dtype=bool)
    for _ in range(num_views):
        usable &= (matches @ usable) >= 2
    rows, _ = covering_rows(pack_rows(visible), pack_rows(usable[None])[0], 2)
    fixed = usable & (rng.random(num_views) < 0.15)
    program = ViewProgram(
        rows=rows,
        matches=matches,
        usable=usable,
        fixed=fixed,
        n_match=2,
        min_views=int(rng.integers(0, usable.sum() + 1)),
    )
    return program, visible


def _all_but_one_of(num_views: int) -> tuple[ViewProgram, ViewQuality]:
    """Each two views see a point that one of them must see; the later a view, the better."""
    pairs = np.array(list(itertools.combinations(range(num_views), 2)))
    program = ViewProgram(
        rows=CoveringRows(
            bits=pack_rows(np.eye(num_views, dtype=bool)[pairs].any(axis=1)),
            bounds=np.ones(len(pairs), dtype=np.int64),
        ),
        matches=~np.eye(num_views, dtype=bool),
        usable=np.ones(num_views, dtype=bool),
        fixed=np.zeros(num_views, dtype=bool),
        n_match=2,
        min_views=1,
    )
    return program, ViewQuality(quality=np.arange(1.0, num_views + 1), viewpoint=np.arange(num_views))


@pytest.mark.parametrize("num_views", [5, 6, 7])
def test_halves_of_views_are_no_solution(num_views: int) -> None:
    """Half of each view would do for the linear relaxation."""
    program, worth = _all_but_one_of(num_views)
    smallest = smallest_selection(program, worth.quality, 1000)
    assert smallest.selected.sum() == smallest.size_bound == num_views - 1
    best = best_selection(program, smallest, worth, 1000)
    assert best.selected.tolist() == [False] + [True] * (num_views - 1)
    assert best.quality == best.quality_bound


@many
@given(seeds, st.integers(3, 11))
def test_the_solver_finds_the_optimum_of_brute_force(seed: int, num_views: int) -> None:
    program, visible = _random_program(seed, num_views)
    rng = np.random.default_rng(seed)
    worth = ViewQuality(quality=rng.uniform(0, 5, num_views), viewpoint=rng.integers(0, 4, num_views))
    bounds = np.minimum((visible & program.usable).sum(axis=1), 2)
    feasible = [
        subset
        for subset in _subsets(num_views)
        if not (subset & ~program.usable).any()
        and subset[program.fixed].all()
        and subset.sum() >= program.min_views
        and ((visible @ subset.astype(int)) >= bounds).all()
        and ((program.matches @ subset.astype(int))[subset] >= 2).all()
    ]
    smallest = min(subset.sum() for subset in feasible)
    best = max(total_quality(subset, worth) for subset in feasible if subset.sum() == smallest)

    greedy = greedy_selection(program, worth.quality)
    assert any(np.array_equal(greedy, subset) for subset in feasible)
    for reduced in (program, replace(program, rows=reduce_rows(program.rows, pack_rows(program.fixed[None])[0]))):
        found = smallest_selection(reduced, worth.quality, 1000)
        assert any(np.array_equal(found.selected, subset) for subset in feasible)
        assert found.selected.sum() == smallest == found.size_bound
        found = best_selection(reduced, found, worth, 1000)
        assert any(np.array_equal(found.selected, subset) for subset in feasible)
        assert found.selected.sum() == smallest
        assert found.quality == pytest.approx(best)
        assert found.quality_bound == found.quality


@pytest.mark.parametrize("share", [0.0, 1.0], ids=["selects nothing", "selects all"])
def test_a_solver_that_violates_its_own_constraints_is_not_believed(
    share: float, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Neither would the search end, nor would a selection of none, or of more than the size asked for, be right.

    The first view must be in, which the five of most quality leave out.
    """
    program, worth = _all_but_one_of(6)
    bits = np.concatenate([program.rows.bits, np.ones((1, 1), dtype=np.uint64)])
    program = replace(program, rows=CoveringRows(bits=bits, bounds=np.ones(len(bits), dtype=np.int64)))
    honest = smallest_selection(program, worth.quality, 1000)
    monkeypatch.setattr(ilp._Model, "solve", lambda self, max_nodes: (np.full(6, share), 9.0))
    best = best_selection(program, honest, worth, 1000)
    assert program.is_met_by(best.selected) and best.selected.sum() == 5
    if share == 0:
        assert best.quality_bound == 20
        distrusted = smallest_selection(program, worth.quality, 1000)
        assert distrusted.selected.sum() == 5 and distrusted.size_bound == 1
        assert caplog.text.count("the solver violates its own constraints") == 2


@many
@given(seeds, st.integers(4, 11), st.data())
def test_where_nothing_else_binds_the_quality_is_that_of_the_best_spread(
    seed: int, num_views: int, data: st.DataObject
) -> None:
    rng = np.random.default_rng(seed)
    size = data.draw(st.integers(3, num_views))
    fixed = rng.random(num_views) < 0.2
    fixed[np.flatnonzero(fixed)[size:]] = False
    program = ViewProgram(
        rows=CoveringRows(bits=np.empty((0, 1), dtype=np.uint64), bounds=np.empty(0, dtype=np.int64)),
        matches=~np.eye(num_views, dtype=bool),
        usable=np.ones(num_views, dtype=bool),
        fixed=fixed,
        n_match=2,
        min_views=size,
    )
    worth = ViewQuality(quality=rng.uniform(0, 5, num_views), viewpoint=rng.integers(0, 4, num_views))
    found = best_selection(program, smallest_selection(program, worth.quality, 1000), worth, 1000)
    allowed = [s for s in _subsets(num_views) if s.sum() == size and s[fixed].all()]
    assert found.selected.sum() == size
    assert found.quality == pytest.approx(max(total_quality(s, worth) for s in allowed))
    assert found.quality_bound == found.quality


@many
@given(seeds, st.integers(1, 10), st.integers(1, 4))
def test_reduction_keeps_exactly_the_same_solutions(seed: int, num_views: int, n_vis: int) -> None:
    rng = np.random.default_rng(seed)
    visible = rng.random((rng.integers(0, 40), num_views)) < rng.uniform(0.05, 0.9)
    usable = rng.random(num_views) < 0.8
    rows, num_seen_by = covering_rows(pack_rows(visible), pack_rows(usable[None])[0], n_vis)
    counts = (visible & usable).sum(axis=1)
    assert num_seen_by.tolist() == [int((counts == number).sum()) for number in range(n_vis)]
    fixed = required_views(rows) | pack_rows((usable & (rng.random(num_views) < 0.2))[None])[0]
    reduced = reduce_rows(rows, fixed)
    assert len(reduced.bounds) <= len(np.unique(visible & usable, axis=0))

    subsets = _subsets(num_views)
    subsets = subsets[~(subsets & ~usable).any(axis=1)]
    wanted = ((subsets @ visible.T.astype(int)) >= np.minimum(counts, n_vis)).all(axis=1)
    required = unpack_rows(required_views(rows)[None], num_views)[0]
    assert subsets[wanted][:, required].all()
    with_fixed = subsets[:, unpack_rows(fixed[None], num_views)[0]].all(axis=1)
    covered = subsets @ unpack_rows(reduced.bits, num_views).T.astype(int)
    np.testing.assert_array_equal((covered >= reduced.bounds).all(axis=1)[with_fixed], wanted[with_fixed])


def _problems(seed: int, num_images: int) -> list[ViewProblem]:
    scene = random_scene(seed, num_images=num_images)
    options = ClusteringOptions(sample_spacing_m=4.0, min_cameras_per_cluster=3)
    clustering = cluster_views(scene, options)
    cutter = ProblemCutter(scene)
    return [cutter.problem(cluster, Visibility.TRACKS) for cluster in clustering.clusters]


@few
@given(seeds, methods, of_reference, st.integers(1, 3), st.integers(1, 3), st.integers(1, 6))
def test_a_selection_meets_every_constraint_that_is_not_relaxed(
    seed: int, method: SelectionMethod, visibility: Visibility, n_vis: int, n_match: int, n_low: int
) -> None:
    options = SelectionOptions(
        method=method, visibility=visibility, n_vis=n_vis, n_match=n_match, n_low=n_low, min_shared_points=3
    )
    for problem in _problems(seed, 30)[:5]:
        names = problem.image_names
        seen = plain.visibility_matrix(problem.samples_in_world, problem.image_from_world, problem.sizes_px)
        keypoints = plain.visibility_matrix(problem.keypoints_in_world, problem.image_from_world, problem.sizes_px)
        if visibility is Visibility.TRACKS:
            keypoints[:] = False
            keypoints[problem.observations[:, 0], problem.observations[:, 1]] = True
        seen = np.concatenate([keypoints, seen])
        matches = plain.share_at_least([set(np.flatnonzero(column).tolist()) for column in seen.T], 3)

        found = select_views(problem, options)
        listed = [*found.image_names, *itertools.chain(*found.not_selected.values())]
        assert sorted(listed) == list(names)
        selected = np.isin(names, found.image_names)
        excluded = np.zeros(len(names), dtype=bool)
        for reason, views in found.not_selected.items():
            if reason.startswith("matches fewer"):
                excluded = np.isin(names, views)
        usable = ~excluded
        required_matches = n_match
        for text in found.relaxed:
            if text.startswith("views match"):
                required_matches = int(text.split()[2])
        assert (matches[selected][:, selected].sum(axis=1) >= required_matches).all()
        assert (matches[usable][:, usable].sum(axis=1) >= required_matches).all()
        usable_counts = seen[:, usable].sum(axis=1)
        assert (seen[:, selected].sum(axis=1) >= np.minimum(usable_counts, n_vis)).all()
        wanted = options.min_views(len(names))
        assert selected.sum() >= min(wanted, usable.sum())
        for number in range(n_vis):
            count = int((usable_counts == number).sum())
            told = [text for text in found.relaxed if f"seen by {number} instead" in text]
            assert bool(told) == bool(count)
            assert not told or told[0].startswith(f"{count} of the points ")
        assert found.size_gap == 0


@few
@given(seeds)
def test_optimal_is_never_larger_than_paper_and_best_among_its_size(seed: int) -> None:
    for problem in _problems(seed, 12)[:3]:
        options = SelectionOptions(n_low=3, n_high=5, min_shared_points=3)
        optimal = select_views(problem, options)
        paper = select_views(problem, replace(options, method=SelectionMethod.PAPER))
        assert len(optimal.image_names) <= len(paper.image_names)
        if len(optimal.image_names) == len(paper.image_names) and paper.image_names:
            visible = visible_points(problem, options.visibility)
            chosen = np.isin(problem.image_names, paper.image_names)
            assert optimal.quality >= total_quality(chosen, view_quality(problem, visible)) - 1e-6


@few
@given(seeds, methods)
def test_the_paper_forces_the_best_seeing_views(seed: int, method: SelectionMethod) -> None:
    options = SelectionOptions(method=SelectionMethod.PAPER, n_low=4, n_high=6, min_shared_points=3)
    for problem in _problems(seed, 20)[:4]:
        found = select_views(problem, options)
        points = np.concatenate([problem.keypoints_in_world, problem.samples_in_world])
        num_seen = plain.visibility_matrix(points, problem.image_from_world, problem.sizes_px).sum(axis=0)
        excluded = next((v for r, v in found.not_selected.items() if r.startswith("matches fewer")), ())
        usable = [row for row, name in enumerate(problem.image_names) if name not in excluded]
        best = sorted(usable, key=lambda row: (-num_seen[row], row))[: found.min_views]
        assert {problem.image_names[row] for row in best} <= set(found.image_names)


@few
@given(seeds, seeds, methods, visibilities)
def test_ids_and_the_order_of_points_do_not_matter(
    seed: int, order: int, method: SelectionMethod, visibility: Visibility
) -> None:
    scene = random_scene(seed)
    other, _ = shuffled(scene, order)
    clustering = cluster_views(scene, ClusteringOptions(sample_spacing_m=4.0))
    options = SelectionOptions(method=method, visibility=visibility)
    for cluster in clustering.clusters[:4]:
        expected = select_views(ProblemCutter(scene).problem(cluster, visibility), options)
        assert select_views(ProblemCutter(other).problem(cluster, visibility), options) == expected


def test_rows_without_points() -> None:
    empty = CoveringRows(bits=np.empty((0, 2), dtype=np.uint64), bounds=np.empty(0, dtype=np.int64))
    assert len(reduce_rows(empty, required_views(empty)).bounds) == 0
