"""Selections that can be checked by hand."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from app.clustering.clusters import Cluster, Clustering, cluster_views
from app.clustering.grid import GroundGrid
from app.clustering.options import ClusteringOptions
from app.clustering.stage import cluster
from app.errors import InputError
from app.scene.posed_scene import PosedScene
from app.scene.read_model import open_scene
from app.scene.submodel import write_submodel
from app.view_selection import stage
from app.view_selection.options import SelectionMethod, SelectionOptions, Visibility
from app.view_selection.problem import ProblemCutter, ViewProblem
from app.view_selection.quality import view_quality
from app.view_selection.selection import read_selections, select_views
from app.view_selection.visibility import visible_points
from tests.reference.posed_scenes import level_camera, make_scene, random_scene

WALL = [[10.0 + 0.01 * k, y, z] for k, y in enumerate(np.linspace(-8, 8, 9)) for z in (1.0, 2.0)]


def _problem(scene: PosedScene, *, spacing: float = 20.0) -> ViewProblem:
    """All views of a scene and one block from (0, -10) to (20, 10); with this spacing, one sample in its middle."""
    grid = GroundGrid(origin_m=(0.0, -10.0), block_size_m=(20.0, 20.0), overlap_m=0.0, sample_spacing_m=spacing)
    found = Cluster(
        name="x0000_y0000",
        grid=grid,
        cells=((0, 0),),
        z_range_m=(0.0, 3.0),
        num_keypoints=len(scene.point_ids),
        is_small=False,
        image_names=scene.image_names,
    )
    return ProblemCutter(scene).problem(found, Visibility.TRACKS)


def _abreast(count: int, step: float = 0.5, x: float = 0.0) -> dict[str, np.ndarray]:
    """Cameras side by side that look along +x at a wall 10 m away."""
    return {f"{k:02d}.jpg": level_camera([x, step * (k - count / 2), 1.5], 0) for k in range(count)}


def test_problem_holds_the_padded_cells_and_the_tracks_between_them() -> None:
    """One of three points lies outside; the image c sees it and nothing else."""
    scene = make_scene(
        _abreast(3), [[19, 0, 1], [10, 5, 1], [21, 0, 1]], [["00.jpg", "01.jpg"], ["00.jpg", "01.jpg"], ["02.jpg"] * 2]
    )
    problem = _problem(scene, spacing=1.0)
    assert problem.keypoints_in_world.tolist() == [[10, 5, 1], [19, 0, 1]]
    assert problem.observations.tolist() == [[0, 0], [0, 1], [1, 0], [1, 1]]
    assert len(problem.samples_in_world) == 20 * 20 * 3
    np.testing.assert_allclose(problem.directions_in_world, [[1, 0, 0]] * 3, atol=1e-12)
    np.testing.assert_allclose(problem.centers_in_world, scene.centers_in_world)


def test_an_image_that_is_not_in_the_model() -> None:
    scene = make_scene(_abreast(3), WALL)
    problem_scene = make_scene(_abreast(2), WALL)
    grid = GroundGrid(origin_m=(0.0, -10.0), block_size_m=(20.0, 20.0), overlap_m=0.0, sample_spacing_m=20.0)
    found = Cluster(
        name="x", grid=grid, cells=((0, 0),), z_range_m=(0, 3), num_keypoints=1, is_small=False,
        image_names=scene.image_names,
    )  # fmt: skip
    with pytest.raises(InputError, match=r"02\.jpg.*not in the model"):
        ProblemCutter(problem_scene).problem(found, Visibility.TRACKS)


def test_n_min_views_are_enough_where_all_see_all() -> None:
    problem = _problem(make_scene(_abreast(40), WALL))
    found = select_views(problem, SelectionOptions(min_shared_points=5))
    assert len(found.image_names) == found.min_views == found.size_bound == 20
    assert [len(names) for names in found.not_selected.values()] == [20]
    assert next(iter(found.not_selected)).startswith("not needed")


def test_a_point_that_few_see_needs_all_of_them_and_it_is_said() -> None:
    """Twelve views see the wall. The point x behind them is in sight of one view only: side, which also sees the wall,
    or back, which matches no other view.

        x . . < back  > > > > wall
                             ^ side
    """
    options = SelectionOptions(n_match=1, min_shared_points=1)
    points = [*WALL, [1.0, 0.0, 1.5]]
    cameras = _abreast(12, x=4.0)
    side = make_scene(cameras | {"side.jpg": level_camera([9.5, -9.5, 1.5], 90)}, points)
    found = select_views(_problem(side), options)
    assert "side.jpg" in found.image_names
    assert found.relaxed == ("1 of the points seen by 1 instead of 2 usable views",)
    back = make_scene(cameras | {"back.jpg": level_camera([6, 0, 1.5], 180)}, points)
    found = select_views(_problem(back), options)
    assert found.relaxed == ("1 of the points seen by 0 instead of 2 usable views",)
    assert found.not_selected["matches fewer than 1 usable views"] == ("back.jpg",)


def test_views_without_partners_are_excluded_and_two_views_are_still_a_pair() -> None:
    options = SelectionOptions(min_shared_points=5)
    pair = select_views(_problem(make_scene(_abreast(2), WALL)), options)
    assert pair.image_names == ("00.jpg", "01.jpg")
    assert "views match 1 others instead of 2: no set of views has more" in pair.relaxed
    assert "2 usable views instead of N_min = 10" in pair.relaxed
    back_to_back = {"a.jpg": level_camera([5, 0, 1.5], 0), "b.jpg": level_camera([5, 0, 1.5], 180)}
    nothing = select_views(_problem(make_scene(back_to_back, WALL)), options)
    assert nothing.image_names == ()
    assert nothing.not_selected == {"matches fewer than 1 usable views": ("a.jpg", "b.jpg")}
    assert nothing.size_gap == nothing.quality_gap == 0


def test_near_and_frontal_views_are_better_and_the_back_of_a_wall_counts_nothing() -> None:
    """Views at 10 m, at 5 m, at 10 m but 60 degrees off, and behind the wall.

    far . . . near . . . wall . . . behind
                    oblique
    """
    cameras = {
        "far.jpg": level_camera([0, 0, 1.5], 0),
        "near.jpg": level_camera([5, 0, 1.5], 0),
        "oblique.jpg": level_camera([5, -8.66, 1.5], 60),
        "behind.jpg": level_camera([16, 0, 1.5], 180),
    }
    points = [[10 + 0.001 * k, 0.2 * k - 1, 1.5] for k in range(10)]
    problem = _problem(make_scene(cameras, points, [["far.jpg", "near.jpg"]] * 10))
    worth = view_quality(problem, visible_points(problem, Visibility.FRUSTUM))
    quality = dict(zip(problem.image_names, worth.quality, strict=True))
    assert quality["near.jpg"] == pytest.approx(10, rel=0.01)
    assert quality["far.jpg"] == pytest.approx(5, rel=0.05)
    assert quality["oblique.jpg"] == pytest.approx(5 * np.cos(np.radians(60)), rel=0.1)
    assert quality["behind.jpg"] == 0


def test_views_from_one_place_in_one_heading_are_one_viewpoint() -> None:
    """Points are 10 m away, where 5 degrees are 0.87 m: cubes end at 0.87, 1.75, ..."""
    cameras = {
        "a.jpg": level_camera([0.1, 0.1, 0.1], 0),
        "b.jpg": level_camera([0.1, 0.5, 0.1], 5),
        "c.jpg": level_camera([0.1, 1.2, 0.1], 0),
        "d.jpg": level_camera([0.1, 0.1, 0.1], 45),
    }
    problem = _problem(make_scene(cameras, [[10.1, y, 1.5] for y in np.linspace(-1, 1, 9)]))
    a, b, c, d = view_quality(problem, visible_points(problem, Visibility.FRUSTUM)).viewpoint
    assert a == b
    assert len({a, c, d}) == 3


def test_optimal_spreads_the_views_over_viewpoints() -> None:
    """Forty views along 20 m of wall: with 12 to choose, no two come from the same 0.87 m."""
    problem = _problem(make_scene(_abreast(40), WALL))
    options = SelectionOptions(min_shared_points=5, n_low=12, n_high=12)
    visible = visible_points(problem, Visibility.FRUSTUM)
    viewpoint = dict(zip(problem.image_names, view_quality(problem, visible).viewpoint.tolist(), strict=True))
    found = select_views(problem, options)
    assert len(found.image_names) == 12
    assert len({viewpoint[name] for name in found.image_names}) == 12
    assert found.quality_gap == 0


def test_keypoints_count_by_track_if_asked_to() -> None:
    cameras = _abreast(12)
    tracks = [["00.jpg", "01.jpg"]] + [["02.jpg", "03.jpg"]] * (len(WALL) - 1)
    problem = _problem(make_scene(cameras, WALL, tracks))
    visible = visible_points(problem, Visibility.TRACKS)
    assert np.bitwise_count(visible.by_point).sum() == 2 * len(WALL) + 12
    options = SelectionOptions(visibility=Visibility.TRACKS, min_shared_points=1, n_low=4, n_high=4)
    assert select_views(problem, options).image_names == ("00.jpg", "01.jpg", "02.jpg", "03.jpg")


def test_minimum_number_of_views_adapts_and_is_clamped() -> None:
    options = SelectionOptions()
    assert [options.min_views(n) for n in (5, 20, 21, 40, 41, 60, 61, 500)] == [10, 10, 11, 20, 21, 30, 30, 30]


def test_stage_does_not_depend_on_the_number_of_workers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stage, "_MIN_CLUSTERS_PER_WORKER", 1)
    monkeypatch.setattr(stage, "_BATCH", 1)
    write_submodel(random_scene(5), np.arange(24), np.arange(200), tmp_path / "model")
    options = ClusteringOptions(sample_spacing_m=4.0, block_size_m=(10.0, 10.0))
    clustering = cluster(tmp_path / "model", tmp_path / "clusters", options=options)
    steps: list[tuple[int, int]] = []
    for workers in (1, 3):
        stage.select(
            tmp_path / "clusters",
            tmp_path / str(workers),
            options=SelectionOptions(),
            num_workers=workers,
            progress=lambda done, total: steps.append((done, total)),
        )
    total = len(clustering.clusters)
    assert total > 2
    assert steps == [(done, total) for done in range(1, total + 1)] * 2
    names = sorted(path.relative_to(tmp_path / "1") for path in (tmp_path / "1").rglob("*.*"))
    assert len(names) == 2 + total
    for name in names:
        assert (tmp_path / "1" / name).read_bytes() == (tmp_path / "3" / name).read_bytes()
    selections = list(read_selections(tmp_path / "1"))
    assert [s.cluster for s in selections] == [c.name for c in clustering.clusters]
    cutter = ProblemCutter(open_scene(tmp_path / "clusters" / "scene"))
    assert selections[0] == select_views(cutter.problem(clustering.clusters[0], Visibility.TRACKS), SelectionOptions())
    report = json.loads((tmp_path / "1" / "report.json").read_text())
    assert report["num_images_after_selection"] == sum(len(s.image_names) for s in selections)
    assert report["clusters_without_stereo_pair"] == [s.cluster for s in selections if not s.image_names]


def test_damaged_selection_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="run `cityrecon select` first"):
        list(read_selections(tmp_path))
    (tmp_path / "selection.jsonl").write_text('{"cluster": 1}\n')
    with pytest.raises(InputError, match="damaged"):
        list(read_selections(tmp_path))


@pytest.mark.parametrize(
    ("name", "value"),
    [("n_vis", 0), ("n_match", 0), ("n_low", 0), ("n_high", 9), ("min_views_fraction", 1.5), ("min_shared_points", 0),
     ("max_solver_nodes", 0), ("max_pictures", -1)],
)  # fmt: skip
def test_options_are_checked(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{name} must"):
        SelectionOptions(**{name: value})  # type: ignore[arg-type]


def test_a_clustering_read_back_gives_the_same_problems(tmp_path: Path) -> None:
    scene = random_scene(8)
    clustering = cluster_views(scene, ClusteringOptions(sample_spacing_m=4.0))
    clustering.write(tmp_path)
    again = Clustering.read(tmp_path)
    assert again == clustering
    options = SelectionOptions(method=SelectionMethod.PAPER)
    for a, b in zip(clustering.clusters[:3], again.clusters[:3], strict=True):
        cutter = ProblemCutter(scene)
        assert select_views(cutter.problem(a, Visibility.TRACKS), options) == select_views(
            cutter.problem(b, Visibility.TRACKS), options
        )
