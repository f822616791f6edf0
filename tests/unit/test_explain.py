"""Explanations that can be checked by hand."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from app.clustering.clusters import Cluster, cluster_views
from app.clustering.grid import GroundGrid
from app.clustering.map_labels import MapLabels
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
from app.view_selection.picture import BLUE, INK, LIGHT_GREY, NEEDED, NOT_NEEDED, PADDED, SOLID, draw_selection
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
        relaxed=("1 of the points seen by 1 instead of 2 usable views",),
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
        "  relaxed: 1 of the points seen by 1 instead of 2 usable views",
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
    assert sorted(first) == [f"{names[0]}.svg", f"{names[len(names) // 2]}.svg"]
    list(explain(workspace, [names[1]]))
    assert sorted(drawn()) == sorted([*first, f"{names[1]}.svg"])
    list(explain(workspace, [], draw_all=True))
    assert sorted(drawn()) == [f"{name}.svg" for name in names]
    assert {name: drawn()[name] for name in first} == first


def test_the_report_sums_the_explanations(tmp_path: Path) -> None:
    workspace = _selected(random_scene(5), tmp_path / "ws", clustering={"sample_spacing_m": 4.0})
    report = json.loads((workspace.root / "selection" / "report.json").read_text())
    selections = list(read_selections(workspace.root / "selection"))
    for key, name in (("keypoints_seen_by_n_vis", "keypoints"), ("samples_seen_by_n_vis", "samples")):
        sums = [getattr(selection.explanation, name) for selection in selections]
        assert report[key] == {field: sum(getattr(c, field) for c in sums) for field in ("total", "before", "after")}
    assert sum(report["selected_images_by_reason"].values()) == report["num_images_after_selection"]


class _Panels:
    """What a picture of a cluster shows; places are whole numbers of pixels / 10, from the upper left corner."""

    def __init__(self, text: str) -> None:
        root = ElementTree.fromstring(text.replace(' xmlns="http://www.w3.org/2000/svg"', ""))
        ground = root.find("defs/g")
        self.before, self.after = root.findall("svg")
        assert ground is not None
        assert [used.get("href") for used in root.iter("use")] == [f"#{ground.get('id')}"] * 2
        self.ground = ground
        self.texts = [text.text for text in root.iter("text")]

    @staticmethod
    def lines(within: ElementTree.Element, color: str) -> list[tuple[tuple[int, int], str]]:
        """Where each line of a colour begins, and how it goes on: `h1` is a dot, `l170 0` a ray to the right."""
        paths = [path for group in within.findall(f".//g[@stroke='{color}']") for path in group.iter("path")]
        paths += within.findall(f".//path[@stroke='{color}']")
        found = [line for path in paths for line in re.findall(r"M(\d+) (\d+)([a-z][^M]*)", path.get("d", ""))]
        return [((int(x), int(y)), drawn) for x, y, drawn in found]

    def dots(self, within: ElementTree.Element, color: str) -> list[tuple[int, int]]:
        """Places of the round dots of a colour."""
        return [start for start, drawn in self.lines(within, color) if drawn == "h1"]

    def rays(self, within: ElementTree.Element, color: str) -> list[str]:
        """Directions of the rays of a colour."""
        return [drawn for _, drawn in self.lines(within, color) if drawn.startswith("l")]

    @staticmethod
    def boxes(within: ElementTree.Element, color: str) -> list[tuple[int, ...]]:
        """Left, bottom, right, top of filled boxes."""
        (path,) = within.findall(f".//path[@fill='{color}']") or [ElementTree.Element("path")]
        return [tuple(map(int, box)) for box in re.findall(r"M(\d+) (\d+)H(\d+)V(\d+)H\d+z", path.get("d", ""))]


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
    panels = _Panels(draw_selection(problem, cluster, selection, MapLabels()))
    assert len(panels.dots(panels.before, NEEDED)) == 14
    assert len(panels.dots(panels.before, NOT_NEEDED)) == 0
    needed, others, left_out = (panels.dots(panels.after, color) for color in (NEEDED, NOT_NEEDED, LIGHT_GREY))
    assert (len(needed), len(others), len(left_out)) == (2, 3, 9)
    assert {*needed, *others, *left_out} == {*panels.dots(panels.before, NEEDED)}
    assert "Before: 14 views" in panels.texts and "After: 5 views, N_min = 5" in panels.texts
    # The cells span 40 m, in the 514 pixels that the scale bar leaves, with a margin of 4 % on both sides.
    scale = 5140 / (40 * 1.08)

    def places(*positions: tuple[float, ...]) -> np.ndarray:
        return np.array([(2800 + x * scale, 2570 - y * scale) for x, y, *_ in positions])

    # To half a pixel; points above each other are one dot.
    dots = np.rint(places(*scene.points_in_world)) // 5 * 5
    assert sorted(panels.dots(panels.ground, BLUE)) == sorted({(x, y) for x, y in dots.tolist()})
    np.testing.assert_allclose(panels.boxes(panels.ground, PADDED), [places((-20, -20), (20, 20)).ravel()], atol=0.5)
    back = problem.centers_in_world[[problem.image_names.index(f"back{k}.jpg") for k in range(2)]]
    np.testing.assert_allclose(sorted(needed), sorted(places(*back).tolist()), atol=0.5)
    assert panels.rays(panels.after, NEEDED) == ["l-170 0"] * 2
    assert panels.rays(panels.after, NOT_NEEDED) == ["l170 0"] * 3
    ((_, bar),) = panels.lines(panels.after, INK)
    assert bar == f"v50h{round(10 * scale)}v-50" and "10 m" in panels.texts
    assert not panels.boxes(panels.ground, SOLID)

    tops_m = np.array([[9.0, 9.0, 1.0], [-np.inf, 1.0, 9.0]])
    solid = SolidColumns(corner_m=(10.0, 10.0), column_m=2.0, tops_m=tops_m)
    panels = _Panels(draw_selection(replace(problem, solid=solid), cluster, selection, MapLabels()))
    expected = [places((10, 10), (12, 14)).ravel(), places((12, 14), (14, 16)).ravel()]
    np.testing.assert_allclose(panels.boxes(panels.ground, SOLID), expected, atol=0.5)


def test_a_picture_says_why_each_selected_view_is_in_and_holds_any_name() -> None:
    cameras = {f'a<b> & "c" \x07{k}.jpg': level_camera([0, k, 1.5], 0) for k in range(3)}
    scene = make_scene(cameras, [[10.0, y, 1.0] for y in np.linspace(-2, 4, 8)])
    (cluster,) = cluster_views(scene, ClusteringOptions(min_keypoints_per_block=1)).clusters
    problem = ProblemCutter(scene).problem(cluster, Visibility.FRUSTUM)
    selection = select_views(problem, SelectionOptions(n_match=1, min_shared_points=1))
    panels = _Panels(draw_selection(problem, cluster, selection, MapLabels(unit="steps", up="y")))
    assert {title.text for title in panels.after.iter("title")} == {
        f"{name}: {describe_view(selection, place)}".replace("\x07", "?")
        for place, name in enumerate(selection.image_names)
    }
    assert not list(panels.before.iter("title"))
    assert "10 steps" in panels.texts and "y" in panels.texts
