"""Explanations that can be checked by hand."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from app.clustering.clusters import Cluster, cluster_views
from app.clustering.grid import GroundGrid
from app.clustering.ground_plan import RED, MapLabels
from app.clustering.options import ClusteringOptions
from app.config import RunConfig, update_config
from app.errors import InputError
from app.explain import explain
from app.georegister.georeference import Georeference, GravitySource, ScaleSource
from app.occlusion.solid_columns import SolidColumns
from app.run import Run
from app.scene.posed_scene import PosedScene
from app.scene.submodel import write_submodel
from app.stage import run_stage
from app.stages import cluster_stage, select_stage
from app.view_selection.describe import describe_selection, describe_view
from app.view_selection.explanation import Coverage, Explanation
from app.view_selection.options import SelectionOptions, Visibility
from app.view_selection.picture import NOT_NEEDED, SOLID, draw_panels, draw_selection
from app.view_selection.problem import ProblemCutter
from app.view_selection.selection import Selection, read_selections, select_views
from app.workspace import Workspace
from tests.reference.posed_scenes import level_camera, make_scene, random_scene


def _selected(scene: PosedScene, root: Path, **settings: dict[str, object]) -> Workspace:
    """A workspace in which a scene was clustered and its views selected."""
    root.mkdir()
    run = Run(workspace=Workspace(root), config=update_config(RunConfig(), settings, where="test"))
    images, points = np.arange(len(scene.image_names)), np.arange(len(scene.point_ids))

    def georegister(partial: Path) -> None:
        write_submodel(scene, images, points, partial / "model")
        Georeference(
            crs="local",
            origin_deg_m=None,
            is_metric=False,
            scale_source=ScaleSource.NONE,
            gravity_source=GravitySource.CAMERAS,
            gravity_sigma_deg=1.0,
        ).write(partial / "georeference.json")

    run_stage(root / "georegister", options={}, inputs={}, work=georegister, product=lambda _: "")
    cluster_stage(run)
    select_stage(run)
    return run.workspace


def _selection(**changes: object) -> Selection:
    """Views a, b and c of five; c and d alone see 12 points, a matches b and c only."""
    explanation = Explanation(
        n_vis=2,
        n_match=2,
        keypoints=Coverage(total=100, before=100, after=100),
        samples=Coverage(total=8000, before=7999, after=4000),
        forced=(False, False, False),
        scarce_points=(0, 0, 12),
        critical_points=(0, 1, 34),
        held_views=((), (0,), (0,)),
        fills_min_views=True,
        added_quality=(2.5, 0.0, 1.0),
    )
    selection = Selection(
        cluster="x0003_y0012",
        image_names=("a.jpg", "b.jpg", "cam1/c.jpg"),
        not_selected={"not needed": ("d.jpg",), "matches fewer than 2 usable views": ("e.jpg",)},
        relaxed=("1 points seen by 1 usable views instead of 2",),
        num_points=8100,
        num_rows=3,
        min_views=3,
        size_bound=3,
        explanation=explanation,
        quality=10.0,
        quality_bound=10.0,
    )
    return replace(selection, **changes)


def test_words() -> None:
    assert describe_selection(_selection()).splitlines() == [
        "cluster x0003_y0012: 3 of 5 views selected; N_min = 3, and no smaller set meets every constraint",
        "  keypoints that 2 or more views see: 100.0 % of 100 by all views, 100.0 % by the selected ones",
        "  samples that 2 or more views see: 99.9 % of 8,000 by all views, 50.0 % by the selected ones",
        "  relaxed: 1 points seen by 1 usable views instead of 2",
        "  not selected, 1: not needed",
        "  not selected, 1: matches fewer than 2 usable views",
        "  a.jpg       fills N_min = 3; adds 25.0 % of the quality",
        "  b.jpg       covers 1 point that fewer than 2 other selected views see; matching: keeps a.jpg at N_match = 2;"
        " adds 0.0 % of the quality",
        "  cam1/c.jpg  needed: one of at most 2 usable views that see 12 points; covers 22 more points that fewer than"
        " 2 other selected views see; matching: keeps a.jpg at N_match = 2; adds 10.0 % of the quality",
    ]


def test_words_where_the_solver_stopped_early_and_where_views_were_forced() -> None:
    selection = _selection(size_bound=2, quality=0.0)
    spare = replace(selection, explanation=replace(selection.explanation, fills_min_views=False))
    assert "at least 2 are needed; the solver stopped" in describe_selection(spare)
    assert describe_view(spare, 0) == "no constraint needs it: the solver stopped before it found a smaller set"
    forced = replace(selection, explanation=replace(selection.explanation, forced=(True, True, False)))
    assert describe_view(forced, 0) == "forced: among the N_min = 3 views that see the most points"
    assert describe_view(forced, 1).startswith("forced: among the N_min = 3 views that see the most points; covers 1 p")


def test_words_for_a_cluster_without_a_stereo_pair() -> None:
    cameras = {"a.jpg": level_camera([5, 0, 1.5], 0), "b.jpg": level_camera([5, 0, 1.5], 180)}
    scene = make_scene(cameras, [[10 + 0.1 * k, 0, 1] for k in range(9)])
    clustering = cluster_views(scene, ClusteringOptions())
    problem = ProblemCutter(scene).problem(clustering.clusters[0], Visibility.FRUSTUM)
    text = describe_selection(select_views(problem, SelectionOptions()))
    assert text.startswith(f"cluster {problem.cluster}: 0 of 2 views selected")
    assert "100.0 %" not in text


def test_the_command_explains_named_clusters_or_tabulates_all(tmp_path: Path) -> None:
    workspace = _selected(random_scene(5), tmp_path / "ws", clustering={"sample_spacing_m": 4.0})
    selections = list(read_selections(workspace.root / "selection"))
    assert len(selections) > 2
    table = list(explain(workspace, []))
    assert [line.split()[0] for line in table[2:]] == [selection.cluster for selection in selections]
    chosen, pictures = (selections[2], selections[0]), workspace.root / "selection" / "pictures"
    expected = [*map(describe_selection, chosen), f"pictures: {pictures}"]
    assert list(explain(workspace, [s.cluster for s in chosen])) == expected
    with pytest.raises(InputError, match=f"no cluster {chosen[0].cluster}0; did you mean {chosen[0].cluster}"):
        list(explain(workspace, [f"{chosen[0].cluster}0"]))


def test_the_stage_draws_some_clusters_and_the_command_any(tmp_path: Path) -> None:
    settings = {"clustering": {"sample_spacing_m": 4.0}, "selection": {"max_pictures": 2, "visibility": "occluded"}}
    workspace = _selected(random_scene(5), tmp_path / "ws", **settings)
    names = [selection.cluster for selection in read_selections(workspace.root / "selection")]
    pictures = workspace.root / "selection" / "pictures"

    def drawn() -> dict[str, bytes]:
        return {path.name: path.read_bytes() for path in sorted(pictures.iterdir())}

    first = drawn()
    assert sorted(first) == [f"{names[0]}.png", f"{names[len(names) // 2]}.png"]
    list(explain(workspace, [names[1]]))
    assert sorted(drawn()) == sorted([*first, f"{names[1]}.png"])
    list(explain(workspace, [], draw_all=True))
    assert sorted(drawn()) == [f"{name}.png" for name in names]
    assert {name: drawn()[name] for name in first} == first


def test_the_report_sums_the_explanations(tmp_path: Path) -> None:
    workspace = _selected(random_scene(5), tmp_path / "ws", clustering={"sample_spacing_m": 4.0})
    report = json.loads((workspace.root / "selection" / "report.json").read_text())
    selections = list(read_selections(workspace.root / "selection"))
    for key, name in (("keypoints_seen_by_n_vis", "keypoints"), ("samples_seen_by_n_vis", "samples")):
        sums = [getattr(selection.explanation, name) for selection in selections]
        assert report[key] == {field: sum(getattr(c, field) for c in sums) for field in ("total", "before", "after")}
    assert sum(report["selected_images_by_reason"].values()) == report["num_images_after_selection"]


def _count(image: np.ndarray, color: tuple[int, int, int]) -> int:
    return int(np.all(image == color, axis=-1).sum())


def test_a_picture_shows_all_views_before_and_the_selected_ones_after() -> None:
    """Twelve views in a row see a wall; only two that look the other way see the points x, so both are needed.

    x      > > > >   < <   wall
    """
    wall = [[10.0 + 0.01 * k, y, z] for k, y in enumerate(np.linspace(-8, 8, 9)) for z in (1.0, 2.0)]
    cameras = {f"{k:02d}.jpg": level_camera([0, k - 6, 1.5], 0) for k in range(12)}
    cameras |= {f"back{k}.jpg": level_camera([5, 2 * k, 1.5], 180) for k in range(2)}
    scene = make_scene(cameras, wall + [[-8.0, 1.0, 1.0 + 0.1 * k] for k in range(6)])
    grid = GroundGrid(origin_m=(-20.0, -20.0), block_size_m=(40.0, 40.0), overlap_m=0.0, sample_spacing_m=40.0)
    cluster = Cluster(
        name="x0000_y0000",
        grid=grid,
        cells=((0, 0),),
        z_range_m=(0.0, 3.0),
        num_keypoints=len(scene.point_ids),
        is_small=False,
        image_names=scene.image_names,
    )
    problem = ProblemCutter(scene).problem(cluster, Visibility.FRUSTUM)
    selection = select_views(problem, SelectionOptions(n_match=1, n_low=5, n_high=5, min_shared_points=1))
    assert set(selection.image_names) > {"back0.jpg", "back1.jpg"}
    assert len(selection.image_names) == 5
    before, after = draw_panels(problem, cluster, selection, MapLabels())
    dot = _count(before, RED) / 14
    assert dot > 10
    assert _count(after, RED) == pytest.approx(2 * dot, rel=0.2)
    assert _count(after, NOT_NEEDED) == pytest.approx(3 * dot, rel=0.2)
    assert _count(before, NOT_NEEDED) == 0
    whole = draw_selection(problem, cluster, selection, MapLabels())
    assert _count(whole, NOT_NEEDED) > _count(after, NOT_NEEDED)
    assert _count(whole, SOLID) == 0

    solid = SolidColumns(corner_m=(10.0, 10.0), column_m=2.0, tops_m=np.array([[9.0, 1.0], [-np.inf, -np.inf]]))
    before, after = draw_panels(replace(problem, solid=solid), cluster, selection, MapLabels())
    rows, columns = np.nonzero(np.all(before == SOLID, axis=-1))
    assert len(rows) == (np.ptp(rows) + 1) * (np.ptp(columns) + 1)
    assert _count(after, SOLID) == len(rows) > 20
