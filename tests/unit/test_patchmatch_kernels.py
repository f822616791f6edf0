"""Kernels of the PatchMatch back-end against their slow plain twins, on random input."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from mvs_backends.patchmatch import kernels as search
from mvs_backends.patchmatch.averaging import averaged_planes
from mvs_backends.patchmatch.cost import kernels as cost
from mvs_backends.patchmatch.geometry import LevelCamera, depth_and_normal
from mvs_backends.patchmatch.maps.kernels import credible_rows, parallax_rates, smooth_rows, upsample
from tests.reference import patchmatch as plain
from tests.reference.stereo_scene import (
    HEIGHT,
    NUM_SOURCES,
    SIGMAS,
    WIDTH,
    WINDOW,
    grey_image,
    planes_near,
    scene,
    wall_scene,
)


def test_packed_neighbours_are_the_four_pixels() -> None:
    grey = grey_image(np.random.default_rng(0))
    packed = np.empty(grey.size, np.uint32)
    cost.pack_neighbours(grey, packed)
    np.testing.assert_array_equal(packed, plain.packed_neighbours(grey))


@pytest.mark.parametrize("seed", range(3))
def test_patch_cost(seed: int) -> None:
    made, wall = wall_scene(seed, ahead=True)
    rng = np.random.default_rng(seed + 100)
    scratch = cost.new_scratch(NUM_SOURCES)
    found, expected = [], []
    for _ in range(100):
        x, y = int(rng.integers(0, WIDTH)), int(rng.integers(0, HEIGHT))
        nearer = rng.choice([1, 1.02, rng.uniform(-1, 30)])
        slant = rng.choice([1e-3, 0.2])
        plane = (wall[y, x] * nearer + rng.normal(0, [0, slant, slant])).astype(np.float32)
        grey = made.kernel_reference.padded_grey
        variance = cost.sample_reference(grey, x, y, WINDOW, scratch.weight, scratch.centred)
        assert variance == pytest.approx(plain.patch_variance(made.reference.grey, x, y, SIGMAS), rel=1e-3, abs=1e-2)
        np.testing.assert_allclose(
            scratch.weight, plain.patch_weights(made.reference.grey, x, y, SIGMAS), rtol=2e-4, atol=1e-7
        )
        if variance < cost.MIN_VARIANCE:
            continue
        for j, source in enumerate(made.sources):
            found.append(cost.view_cost(j, x, y, *plane, np.float32(variance), made.kernel_sources, WINDOW, scratch))
            expected.append(plain.patch_cost(made.reference, source, x, y, plane.astype(np.float64), SIGMAS))
    np.testing.assert_allclose(found, expected, atol=1e-3)


def test_patch_beside_the_source_image_has_the_largest_cost() -> None:
    made = scene(1)
    scratch = cost.new_scratch(NUM_SOURCES)
    cost.sample_reference(made.kernel_reference.padded_grey, 20, 16, WINDOW, scratch.weight, scratch.centred)
    near = np.float32(10.0)
    assert cost.view_cost(0, 20, 16, near, near * 0, near * 0, near, made.kernel_sources, WINDOW, scratch) == 2


@pytest.mark.parametrize("seed", range(3))
def test_reprojection_error(seed: int) -> None:
    made = scene(seed)
    rng = np.random.default_rng(seed + 200)
    cap = 3.0
    for _ in range(100):
        x, y, w = int(rng.integers(0, WIDTH)), int(rng.integers(0, HEIGHT)), rng.uniform(0.17, 0.25)
        for j, source in enumerate(made.sources):
            found = cost.geometric_error(j, x, y, np.float32(w), made.kernel_sources, np.float32(cap))
            expected = plain.reprojection_error(made.reference, source, made.maps[j].astype(float), x, y, w, cap)
            assert found == pytest.approx(expected, abs=2e-3)


def test_facing_and_normals_agree_with_three_points_of_the_plane() -> None:
    made = scene(0)
    rng = np.random.default_rng(5)
    plane = planes_near(rng, (HEIGHT, WIDTH))
    depth, normal = depth_and_normal(plane, made.reference.calibration)
    for y, x in rng.integers(0, [HEIGHT, WIDTH], (30, 2)):
        expected = plain.normal_of(made.reference, x, y, plane[y, x].astype(float))
        np.testing.assert_allclose(normal[y, x], expected, atol=1e-3)
        assert depth[y, x] == pytest.approx(1 / plane[y, x, 0], rel=1e-5)
        ray = np.linalg.inv(made.reference.calibration) @ [x, y, 1]
        facing = cost.facing(x, y, *plane[y, x], made.kernel_reference.intrinsics)
        assert facing == pytest.approx(-expected @ ray / np.linalg.norm(ray), abs=1e-3)


def test_smoothing() -> None:
    made = scene(2)
    rng = np.random.default_rng(9)
    plane = planes_near(rng, (HEIGHT, WIDTH)) * np.array([1, 0.1, 0.1], np.float32)
    plane[rng.random((HEIGHT, WIDTH)) < 0.2] = 0
    rate = np.zeros((HEIGHT, WIDTH))
    for y, x in np.ndindex(HEIGHT, WIDTH):
        if plane[y, x, 0] > 0:
            rate[y, x] = max(
                plain.px_per_inverse_depth(made.reference, source, x, y, plane[y, x, 0]) for source in made.sources
            )
    found = np.empty_like(plane)
    smooth_rows(0, HEIGHT, 2, plane, made.kernel_reference, made.kernel_sources, found)
    np.testing.assert_allclose(found, plain.smoothed(plane.astype(float), rate, 2), atol=2e-4)


def test_parallax_rates() -> None:
    made = scene(2)
    rng = np.random.default_rng(11)
    points = np.stack([rng.uniform(0, WIDTH, 50), rng.uniform(0, HEIGHT, 50), rng.uniform(0.15, 0.25, 50)], axis=1)
    found = np.empty(50, np.float32)
    parallax_rates(points.astype(np.float32), made.kernel_sources, found)
    expected = [
        max(plain.px_per_inverse_depth(made.reference, source, *point) for source in made.sources) for point in points
    ]
    np.testing.assert_allclose(found, expected, rtol=1e-3)


def test_credible_pixels() -> None:
    made, wall = wall_scene(3)
    rng = np.random.default_rng(10)
    plane = (wall * rng.normal(1, 0.004, (HEIGHT, WIDTH, 1))).astype(np.float32)
    wanted = np.zeros((HEIGHT, WIDTH), np.bool_)
    wanted[4:-4, 4:-4] = rng.random((HEIGHT - 8, WIDTH - 8)) < 0.5
    credible = np.empty((HEIGHT, WIDTH), np.bool_)
    max_cost, scratch = 0.15, cost.new_scratch(NUM_SOURCES)
    views = made.kernel_reference, made.kernel_sources, WINDOW, scratch
    credible_rows(0, HEIGHT, wanted, plane, np.float32(max_cost), *views, credible)
    expected = np.zeros_like(credible)
    for y, x in np.argwhere(wanted):
        here = plane[y, x].astype(float)
        if plain.patch_variance(made.reference.grey, x, y, SIGMAS) < 2:
            continue
        confirming = plain.num_confirming(made.reference, made.sources, made.maps, x, y, here, max_cost, SIGMAS)
        expected[y, x] = confirming >= 2
    np.testing.assert_array_equal(credible, expected)
    assert 30 < expected.sum() < wanted.sum() / 2


@pytest.mark.parametrize(("ahead", "reach"), [(False, 0.5), (True, 0.5), (False, 2.5)])
def test_views_that_agree_are_averaged(ahead: bool, reach: float) -> None:
    """Half a pixel is more than 3 % of the depth to views within 0.5, and between 1 and 3 % farther away."""
    made, wall = wall_scene(5, ahead=ahead, reach=reach)
    rng = np.random.default_rng(11)
    plane = (wall * rng.normal(1, 0.006, (HEIGHT, WIDTH, 1))).astype(np.float32)
    plane[rng.random((HEIGHT, WIDTH)) < 0.1] = 0
    maps = made.maps * np.where(rng.random((*made.maps.shape[:3], 1)) < 0.2, 1.1, 1).astype(np.float32)
    level, *levels = (
        LevelCamera(width=WIDTH, height=HEIGHT, calibration=camera.calibration, cam_from_world=camera.pose)
        for camera in (made.reference, *made.sources)
    )
    loaders = [(its_level, lambda its_map=its_map: its_map) for its_level, its_map in zip(levels, maps, strict=True)]
    with ThreadPoolExecutor(2) as executor:
        found = averaged_planes(plane, level, loaders, executor)
    expected = plain.averaged(made.reference, made.sources, maps.astype(float), plane.astype(float))
    np.testing.assert_allclose(found[..., 0], expected, rtol=2e-5)
    known = plane[..., 0] > 0
    np.testing.assert_allclose(found[known, 1] / found[known, 0], plane[known, 1] / plane[known, 0], rtol=1e-4)
    before, after = (np.std(w[known] / wall[known, 0]) for w in (plane[..., 0], found[..., 0]))
    assert after < (0.7 if reach < 1 else 0.95) * before


def test_upsampling() -> None:
    made = scene(0)
    rng = np.random.default_rng(4)
    shape = (HEIGHT // 2, WIDTH // 2)
    coarse, coarse_grey = planes_near(rng, shape), rng.integers(60, 190, shape).astype(np.uint8)
    coarse[rng.random(shape) < 0.2] = 0
    coarse_cost = rng.uniform(0, 1, shape).astype(np.float32)
    limits = made.kernel_reference.inverse_range.copy()
    limits[:3] = 0
    state = search.State(
        plane=np.empty((HEIGHT, WIDTH, 3), np.float32),
        cost=np.empty((HEIGHT, WIDTH), np.float32),
        best_view=np.empty((HEIGHT, WIDTH), np.int8),
    )
    reference = made.kernel_reference._replace(inverse_range=limits)
    half = np.float32(0.5)
    upsample(coarse, coarse_cost, np.zeros(shape, np.int8), coarse_grey, half, half, state, reference)
    expected = plain.upsampled(coarse.astype(float), coarse_cost, coarse_grey, made.reference.grey, limits)
    np.testing.assert_allclose(state.plane, expected, atol=1e-5)
    assert not state.plane[:3].any()


def test_random_numbers_are_splitmix64s() -> None:
    for state in (1, 12345, 2**63 + 17):
        assert int(search.random_bits(np.uint64(state))) == plain.random_bits(state)


def test_candidates_are_the_best_of_each_area() -> None:
    rng = np.random.default_rng(6)
    state = search.State(
        plane=planes_near(rng, (HEIGHT, WIDTH)),
        cost=rng.uniform(0, 1, (HEIGHT, WIDTH)).astype(np.float32),
        best_view=np.zeros((HEIGHT, WIDTH), np.int8),
    )
    scratch = cost.new_scratch(NUM_SOURCES)
    limits = np.tile([0.17, 0.23], (HEIGHT, WIDTH, 1))
    for x, y in ((0, 0), (20, 16), (39, 31), (1, 30), (5, 12)):
        count = search._gather_candidates(x, y, state, np.float32(0.17), np.float32(0.23), scratch)
        expected = plain.candidate_planes(state.plane, state.cost, limits, x, y)
        np.testing.assert_allclose(scratch.candidates[:count], expected, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("previous", [-1, 1])
def test_view_weights(previous: int) -> None:
    rng = np.random.default_rng(7)
    settings = search.Search(
        seed=0,
        iteration=2,
        max_views=2,
        geometric_weight=np.float32(0),
        max_geometric_px=np.float32(3),
        perturbation_px=np.float32(1),
        normal_perturbation=np.float32(0.1),
        random_depth=0,
    )
    scratch = cost.new_scratch(NUM_SOURCES)
    for _ in range(50):
        # Views that are all bad among them: then the one with the least cost counts.
        costs = rng.uniform(0, 1.6, (9, NUM_SOURCES)) * rng.uniform(0.3, 1, NUM_SOURCES) + rng.choice([0.0, 0.8])
        scratch.costs[:9] = costs
        scratch.multiplicity[:] = 1
        count = search._select_views(9, previous, settings, scratch)
        expected = plain.view_weights(scratch.costs[:9].astype(float), previous, 2)
        if not expected.any():
            assert count == 1
            assert scratch.chosen[0] == np.unravel_index(costs.argmin(), costs.shape)[1]
            continue
        np.testing.assert_allclose(scratch.weights, expected, rtol=1e-4)
        assert list(scratch.chosen[:count]) == list(np.argsort(-expected, kind="stable")[:count])
        assert count == min(2, np.count_nonzero(expected))
