"""The baselines that the program is compared with."""

from __future__ import annotations

import itertools
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import KDTree

from benchmarks.log_chart import write_log_chart
from benchmarks.peers import clique_ilp, metis_cut, tracks
from benchmarks.peers.__main__ import _quality, _Town
from benchmarks.peers.angles import angle_weights
from benchmarks.reference.clustering import sees
from tests.reference.posed_scenes import level_camera, make_scene, random_scene


@pytest.mark.parametrize("at_once", [1, 40, 1 << 25])
def test_common_points_of_pairs_are_counted(at_once: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tracks, "_OBSERVATION_PAIRS_AT_ONCE", at_once)
    rng = np.random.default_rng(1)
    names = [f"{row}.jpg" for row in range(9)]
    cameras = {name: level_camera([row, 0, 1], 0) for row, name in enumerate(names)}
    observed = [list(rng.choice(names, rng.integers(2, 6), replace=False)) for _ in range(60)]
    scene = make_scene(cameras, rng.normal(0, 1, (60, 3)), observed)
    expected: dict[tuple[int, int], int] = {}
    for track in observed:
        for pair in itertools.combinations(sorted(names.index(name) for name in track), 2):
            expected[pair] = expected.get(pair, 0) + 1
    first, second, counts = tracks.count_pairs(scene)
    assert dict(zip(zip(first.tolist(), second.tolist(), strict=True), counts.tolist(), strict=True)) == expected
    point, a, b = tracks.image_pairs(scene)
    assert len(point) == sum(expected.values())
    for row, first, second in zip(point, a, b, strict=True):
        assert {names[first], names[second]} <= set(observed[row])


def test_the_best_angle_is_twenty_degrees_and_smaller_ones_count_less() -> None:
    degrees = np.array([0, 15, 20, 35, 50])
    centers = np.column_stack([np.cos(np.radians(degrees)), np.sin(np.radians(degrees)), 0 * degrees]) * 7
    pairs = np.arange(5)
    weights = angle_weights(np.zeros((1, 3)), centers, 0 * pairs, 0 * pairs, pairs)
    np.testing.assert_allclose(weights, np.exp([-8, -0.5, 0, -0.5, -2]), atol=1e-9)


@pytest.mark.parametrize("share", [0.1, 0.6])
def test_similarity_is_the_mean_over_common_points(share: float) -> None:
    scene = random_scene(2, num_images=9, num_points=40)
    visible = np.random.default_rng(2).random((9, 40)) < share
    similarity = clique_ilp._similarity(visible, scene.points_in_world, scene.centers_in_world)
    for a, b in itertools.combinations(range(9), 2):
        common = np.flatnonzero(visible[a] & visible[b])
        weights = angle_weights(scene.points_in_world, scene.centers_in_world, common, 0 * common + a, 0 * common + b)
        assert similarity[a, b] == similarity[b, a] == pytest.approx(weights.mean() if len(common) else 0)


def test_cliques_select_the_fewest_images_that_triangulate_every_point() -> None:
    """Against all subsets: a clique that counts with two of its images is a pair of similar images."""
    rng = np.random.default_rng(3)
    visible = rng.random((9, 40)) < 0.6
    matchable = np.triu(rng.random((9, 9)) < 0.3, 1)
    matchable |= matchable.T

    def covered(images: tuple[int, ...]) -> np.ndarray:
        pairs = [(a, b) for a, b in itertools.combinations(images, 2) if matchable[a, b]]
        return np.any([np.zeros(40, bool), *(visible[a] & visible[b] for a, b in pairs)], axis=0)

    possible = covered(tuple(range(9)))
    assert 0 < possible.sum() < 40
    fewest = next(
        size
        for size in range(10)
        if any(np.array_equal(covered(images), possible) for images in itertools.combinations(range(9), size))
    )
    chosen = tuple(np.flatnonzero(clique_ilp._select(visible, matchable)).tolist())
    np.testing.assert_array_equal(covered(chosen), possible)
    assert len(chosen) == fewest < 9


def leaves_of_a_band(max_images: int, overlap: int, monkeypatch: pytest.MonkeyPatch) -> list[np.ndarray]:
    """Of 100 images in a row, each of which shares 21 points with the next one and one with that after it."""
    monkeypatch.setattr(metis_cut, "_LEAF_MAX_NUM_IMAGES", max_images)
    monkeypatch.setattr(metis_cut, "_IMAGE_OVERLAP", overlap)
    names = [f"{row:03d}.jpg" for row in range(100)]
    cameras = {name: level_camera([row, 0, 1], 0) for row, name in enumerate(names)}
    observed = [names[row : row + reach] for row in range(98) for reach in (*[2] * 20, 3)]
    return metis_cut.metis_clusters(make_scene(cameras, np.zeros((len(observed), 3)), observed))


def test_halves_get_the_most_alike_images_of_the_other(monkeypatch: pytest.MonkeyPatch) -> None:
    high, low = leaves_of_a_band(60, 1, monkeypatch)
    cut = len(low) - 2
    assert low.tolist() == list(range(cut + 2))
    assert high.tolist() == list(range(cut, 100))


def test_leaves_of_the_cut_hold_all_images_and_share_some(monkeypatch: pytest.MonkeyPatch) -> None:
    leaves = leaves_of_a_band(20, 4, monkeypatch)
    assert set(np.concatenate(leaves)) == set(range(100))
    assert all(len(leaf) <= 24 for leaf in leaves)
    assert 5 <= len(leaves) <= 10
    assert all(np.ptp(leaf) < 40 for leaf in leaves)


def test_coverage_and_matchability_are_those_of_all_pairs() -> None:
    scene = random_scene(8, num_images=30, num_points=800)
    tree = KDTree(scene.points_in_world[::4, :2])
    clusters = [np.arange(6), np.arange(4, 10), np.array([25])]
    covered = np.zeros(200, dtype=bool)
    num_matched = 0
    for images in clusters:
        seen = {
            image: {
                number
                for number, point in enumerate(scene.points_in_world[::4])
                if np.hypot(*(point - scene.centers_in_world[image])[:2]) <= 38
                and sees(scene, image, point[None]).all()
            }
            for image in images
        }
        for number in range(200):
            covered[number] |= sum(number in points for points in seen.values()) >= 2
        for image in images:
            partners = [other for other in images if other != image and len(seen[image] & seen[other]) >= 5]
            num_matched += len(partners) >= 2
    assert 20 < covered.sum() < 180
    assert 2 < num_matched < 12
    town = _Town(model_dir=Path(), scene=scene, tree=tree)
    assert _quality(town, clusters) == pytest.approx((covered.mean(), num_matched / 13))


def test_names_of_lines_that_end_together_do_not_overlap(tmp_path: Path) -> None:
    ends = {"a": (1000.0, 50.0), "b": (1000.0, 51.0), "c": (1000.0, 49.0), "d": (10.0, 50.0)}
    write_log_chart(
        tmp_path / "chart.svg", {name: [(1.0, 1.0), end] for name, end in ends.items()}, x_title="x", y_title="y"
    )
    texts = re.findall(
        r'<text x="([\d.]+)" y="([\d.]+)" fill="[^"]*">(\w)</text>', (tmp_path / "chart.svg").read_text()
    )
    height = {name: float(y) for _, y, name in texts}
    assert height["b"] <= height["a"] - 15
    assert height["a"] <= height["c"] - 15
    assert height["d"] == pytest.approx(height["b"], abs=3)
