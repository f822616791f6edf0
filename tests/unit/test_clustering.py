"""Clusters of scenes that can be drawn by hand. One character is 10 m, so a block is 2 x 2 of them; y is up."""

from __future__ import annotations

import json
import logging
from pathlib import Path

import cv2
import numpy as np
import pytest

from app.clustering.association import Block, DropReason
from app.clustering.clusters import Clustering, cluster_views
from app.clustering.ground_plan import RED
from app.clustering.map_labels import MapLabels
from app.clustering.map_picture import color_numbers, write_map
from app.clustering.merging import merge_small_blocks
from app.clustering.options import ClusteringOptions
from app.clustering.samples import grid_points, height_range, sample_axes
from app.clustering.stage import cluster
from app.errors import InputError
from app.scene.point_index import PointIndex, tile_keys
from app.scene.posed_scene import PosedScene
from app.scene.submodel import write_submodel
from tests.reference.posed_scenes import level_camera, make_scene, random_scene, shuffled


def _patch(x: float, y: float, count: int = 6) -> list[list[float]]:
    """A few points on a wall near (x, y), from the ground up."""
    return [[x + 0.1 * k, y, 0.5 * k] for k in range(count)]


def _street() -> PosedScene:
    """Twelve cameras look along +x at walls a and b; e is too far away, c behind them, d out of reach, s two points.

    . . s . . . . . . . . . . . . .
    . . . . . . . . b . . . . . . .
    . . . . . . . . . . . . . . . .
    . c . . . > . . a . e . . . . d
    """
    cameras = {f"{k:02d}.jpg": level_camera([0.5 * k, 5.0, 1.5], 0) for k in range(12)}
    points = _patch(28, 5) + _patch(28, 25) + _patch(50, 5) + _patch(-35, 5) + _patch(110, 5)
    return make_scene(cameras, points + [[-30, 35, 1], [-30, 36, 1]])


def _at(clustering: Clustering, x: float, y: float) -> list[str]:
    """Names of the clusters whose cells hold a position."""
    return [c.name for c in clustering.clusters if c.region().contains(np.array([[x, y]]))[0]]


def test_walls_in_front_are_clusters_and_the_rest_is_dropped_with_a_reason() -> None:
    clustering = cluster_views(_street(), ClusteringOptions(max_camera_distance_m=40))
    assert len(clustering.clusters) == 2
    a, b = _at(clustering, 28, 5), _at(clustering, 28, 25)
    assert len(a) == len(b) == 1
    assert a != b
    for found in clustering.clusters:
        assert not found.is_small
        assert found.num_keypoints == 6
    reasons = {block.cell: block.reason for block in clustering.dropped}
    behind, stray, too_far = sorted(reasons)
    assert reasons[behind] == reasons[too_far] == DropReason.NO_IMAGE
    assert reasons[stray] == DropReason.FEW_KEYPOINTS
    assert clustering.num_far_keypoints == 6


def test_images_join_by_view_and_by_distance_from_the_block_centre() -> None:
    """Wall a in the block centred at (30, 10). Of four cameras one looks away and one is 41 m from the centre.

    away <. . > near . . [ a ]      far: at x = -11, too far
    """
    cameras = {
        "near.jpg": level_camera([5, 10, 1.5], 0),
        "edge.jpg": level_camera([-9.9, 10, 1.5], 0),
        "far.jpg": level_camera([-11, 10, 1.5], 0),
        "away.jpg": level_camera([5, 10, 1.5], 180),
    }
    options = ClusteringOptions(min_cameras_per_cluster=1, max_camera_distance_m=40)
    clustering = cluster_views(make_scene(cameras, _patch(30, 10)), options)
    assert [c.image_names for c in clustering.clusters] == [("edge.jpg", "near.jpg")]


def test_samples_bring_in_an_image_that_sees_no_keypoint() -> None:
    """The camera at the left border of the block looks up along it, past all keypoints at the right border.

    [ ^     a ]
    """
    cameras = {"a.jpg": level_camera([21, -15, 1.5], 90), "b.jpg": level_camera([0, 10, 1.5], 0)}
    scene = make_scene(cameras, [[39.5, 0.5 + 0.1 * k, 0.5 * k] for k in range(6)])
    (found,) = cluster_views(scene, ClusteringOptions(min_cameras_per_cluster=1)).clusters
    assert found.image_names == ("a.jpg", "b.jpg")


def test_far_outliers_neither_move_nor_grow_the_grid() -> None:
    scene = _street()
    outliers = [[1e15, -1e15, 0.0], [-1e300, 1e300, 0.0], [5e6, 0.0, 0.0]]
    cameras = dict(zip(scene.image_names, scene.cam_from_world, strict=True))
    noisy = make_scene(cameras, scene.points_in_world.tolist() + outliers)
    clean, clustering = cluster_views(scene, ClusteringOptions()), cluster_views(noisy, ClusteringOptions())
    assert clustering.clusters == clean.clusters
    assert clustering.num_far_keypoints == clean.num_far_keypoints + 3


def test_an_image_far_from_all_others_does_no_harm() -> None:
    scene = _street()
    cameras = dict(zip(scene.image_names, scene.cam_from_world, strict=True))
    cameras["99.jpg"] = level_camera([1e12, -1e12, 0], 0)
    found = cluster_views(make_scene(cameras, scene.points_in_world.tolist()), ClusteringOptions())
    assert [c.image_names for c in found.clusters[-2:]] == [
        c.image_names for c in cluster_views(scene, ClusteringOptions()).clusters
    ]


def test_heights_reach_from_the_road_to_the_roofs() -> None:
    facade = np.linspace(3, 9, 101)
    low, high = height_range(facade, np.array([]), quantiles=(0.01, 0.99), margin=1, camera_height=2.5)
    assert low == pytest.approx(3.06 - 1)
    assert high == pytest.approx(8.94 + 1)
    # Keypoints on facades only, but the cameras stand on the road 2.5 m below them.
    low, high = height_range(facade, np.array([1.6, 1.7, 40.0]), quantiles=(0.01, 0.99), margin=1, camera_height=2.5)
    assert low == pytest.approx(1.7 - 2.5 - 1)
    assert high == pytest.approx(8.94 + 1)
    with_noise = np.append(np.tile(facade, 3), [-80.0, 300.0])
    assert height_range(with_noise, np.array([]), quantiles=(0.01, 0.99), margin=1, camera_height=2.5)[1] < 11


def test_samples_fill_a_box_evenly() -> None:
    box = np.array([[0.0, 10.0, -1.0], [4.0, 12.0, -0.5]])
    x, y, z = sample_axes(box, 1.0)
    assert x.tolist() == [0.5, 1.5, 2.5, 3.5]
    assert y.tolist() == [10.5, 11.5]
    assert z.tolist() == [-0.75]
    assert len(np.unique(grid_points((x, y, z)), axis=0)) == 8


@pytest.mark.parametrize("is_sorted", [True, False])
def test_point_index_finds_rows_in_a_rectangle(is_sorted: bool) -> None:
    points = np.random.default_rng(0).uniform(-300, 300, (3000, 3))
    points[::50] *= 1e12
    if is_sorted:
        points = points[np.argsort(tile_keys(points))]
    index = PointIndex(points)
    for low, high in (
        ((-20, -3), (10, 140)),
        ((-310, -310), (310, 310)),
        ((-33, -47), (55, 71)),
        ((7, 7), (9, 9)),
        ((900, 0), (950, 20)),
    ):
        inside = np.all((points[:, :2] >= low) & (points[:, :2] <= high), axis=1)
        found = index.rows_between(np.array(low, dtype=float), np.array(high, dtype=float))
        assert found.tolist() == np.flatnonzero(inside).tolist()


def _block(i: int, j: int, images: list[int]) -> Block:
    return Block(cells=((i, j),), num_keypoints=1, z_range_m=(float(i), i + 10.0), image_rows=np.array(images))


def test_a_small_block_joins_the_side_that_shares_most_images() -> None:
    """The block in the middle has two images. Its neighbour at the corner shares both, those beside it one and none.

    corner . .
    one  SMALL none
    """
    small, corner = _block(1, 0, [1, 2]), _block(0, 1, [1, 2, 3])
    one, none = _block(0, 0, [2, 8, 9]), _block(2, 0, [5, 6, 7])
    merged = merge_small_blocks([none, small, corner, one], 3)
    assert [block.cells for block in merged] == [((0, 0), (1, 0)), ((0, 1),), ((2, 0),)]
    assert merged[0].image_rows.tolist() == [1, 2, 8, 9]
    assert merged[0].z_range_m == (0.0, 11.0)
    assert merged[0].num_keypoints == 2
    # Without a neighbour beside it, the corner will do.
    assert [block.cells for block in merge_small_blocks([small, corner], 3)] == [((0, 1), (1, 0))]


def test_merging_goes_on_until_it_is_enough_and_never_wraps_around() -> None:
    """A row of five one-image blocks becomes one; the block at the other end of the next row is no neighbour.

    x . . . . . . .
    . . . x x x x x
    """
    row = [_block(3 + k, 0, [k]) for k in range(5)]
    alone = _block(0, 1, [100])
    merged = merge_small_blocks([*row, alone], 5)
    assert [block.cells for block in merged] == [((0, 1),), tuple((3 + k, 0) for k in range(5))]
    assert merged[1].image_rows.tolist() == [0, 1, 2, 3, 4]
    assert len(merged[0].image_rows) == 1


def test_a_cluster_that_stays_small_is_kept_and_flagged() -> None:
    cameras = {f"{k}.jpg": level_camera([0, 5 + k, 1.5], 0) for k in range(3)}
    (found,) = cluster_views(make_scene(cameras, _patch(28, 5)), ClusteringOptions()).clusters
    assert found.is_small
    assert len(found.image_names) == 3


def test_stage_writes_what_it_found(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_submodel(_street(), np.arange(12), np.arange(32), tmp_path / "model")
    with caplog.at_level(logging.INFO):
        clustering = cluster(tmp_path / "model", tmp_path / "a", options=ClusteringOptions())
        cluster(tmp_path / "model", tmp_path / "b", options=ClusteringOptions())
    assert Clustering.read(tmp_path / "a") == clustering
    report = json.loads((tmp_path / "a" / "report.json").read_text())
    assert report["num_images_after_clustering"] == sum(len(c.image_names) for c in clustering.clusters)
    assert report["num_clusters"] == len(clustering.clusters)
    assert len(report["dropped_blocks"]) == len(clustering.dropped)
    assert "12 images in" in caplog.text
    for name in ("clusters.jsonl", "report.json", "map.png"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_a_model_that_gives_no_cluster(tmp_path: Path) -> None:
    scene = make_scene({f"{k}.jpg": level_camera([0, k, 0], 180) for k in range(3)}, _patch(200, 0))
    write_submodel(scene, np.arange(3), np.arange(6), tmp_path / "model")
    with pytest.raises(InputError, match="no block"):
        cluster(tmp_path / "model", tmp_path / "out", options=ClusteringOptions())


def test_damaged_clusters_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="run `cityrecon cluster` first"):
        Clustering.read(tmp_path)
    for content in ("", "{}\n", "not json\n", '{"format_version": 99}\n'):
        (tmp_path / "clusters.jsonl").write_text(content)
        with pytest.raises(InputError, match="clusters.jsonl"):
            Clustering.read(tmp_path)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("block_size_m", (0.0, 20.0)),
        ("overlap_m", 20.0),
        ("sample_spacing_m", 0.0),
        ("min_keypoints_per_block", 0),
        ("max_camera_distance_m", float("inf")),
        ("min_cameras_per_cluster", 0),
        ("height_quantiles", (0.9, 0.1)),
        ("height_margin_m", -1.0),
        ("camera_height_m", float("nan")),
    ],
)
def test_options_are_checked(name: str, value: object) -> None:
    with pytest.raises(ValueError, match=f"{name} must"):
        ClusteringOptions(**{name: value})  # type: ignore[arg-type]


def test_neighbours_on_the_map_have_different_colours() -> None:
    cells = [((i, j),) for i in range(9) for j in range(9)]
    numbers = dict(zip((one for (one,) in cells), color_numbers(cells), strict=True))
    for (i, j), number in numbers.items():
        around = [(i + di, j + dj) for di in (-1, 0, 1) for dj in (-1, 0, 1) if (di, dj) != (0, 0)]
        assert number not in [numbers[cell] for cell in around if cell in numbers]
    assert len(set(numbers.values())) > 4
    merged = [((0, 0), (1, 0)), ((2, 0),), ((3, 0), (3, 1))]
    assert len(set(color_numbers(merged)[:2])) == 2


def test_the_map_is_the_same_whatever_the_order_of_points(tmp_path: Path) -> None:
    scene = random_scene(4)
    other, _ = shuffled(scene, 1)
    for name, one in (("a.png", scene), ("b.png", other)):
        write_map(one, cluster_views(one, ClusteringOptions()), tmp_path / name, MapLabels())
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    image = cv2.imread(str(tmp_path / "a.png"))
    assert image is not None and (image == RED).all(axis=-1).sum() > 100
