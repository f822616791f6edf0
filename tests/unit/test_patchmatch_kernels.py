"""Kernels of the PatchMatch back-end against their slow plain twins, on random input."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from mvs_backends.patchmatch import kernels as search
from mvs_backends.patchmatch.cost import kernels as cost
from mvs_backends.patchmatch.geometry import LevelCamera, depth_and_normal, warp
from mvs_backends.patchmatch.maps.kernels import credible_rows, smooth_rows, upsample
from mvs_backends.patchmatch.options import PatchMatchOptions
from mvs_backends.patchmatch.search import window
from tests.reference import patchmatch as plain

WIDTH, HEIGHT, NUM_SOURCES = 40, 32, 3
OPTIONS = PatchMatchOptions()
WINDOW = window(OPTIONS)


@dataclass
class Scene:
    reference: plain.Camera
    sources: list[plain.Camera]
    maps: np.ndarray
    kernel_reference: cost.Reference
    kernel_sources: cost.Sources


def grey_image(rng: np.random.Generator) -> np.ndarray:
    coarse = rng.uniform(60, 190, (HEIGHT // 4 + 2, WIDTH // 4 + 2))
    fine = np.kron(coarse, np.ones((4, 4)))[:HEIGHT, :WIDTH] + rng.uniform(-12, 12, (HEIGHT, WIDTH))
    return fine.astype(np.uint8)


def planes_near(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Random planes about 5 away, mildly slanted."""
    w = 1 / rng.uniform(4.5, 5.5, shape)
    slopes = rng.uniform(-0.003, 0.003, (*shape, 2))
    return np.concatenate([w[..., None], slopes], axis=-1).astype(np.float32)


def scene(seed: int, *, reach: float = 0.4, num_alike: int = 0) -> Scene:
    """A reference and sources up to `reach` beside it; the first `num_alike` of them show the same image.

    Its left half is a smooth shade then.
    """
    rng = np.random.default_rng(seed)
    calibration = np.array([[45.0, 0, WIDTH / 2], [0, 44.0, HEIGHT / 2], [0, 0, 1]])
    cameras = []
    for i in range(NUM_SOURCES + 1):
        angles = rng.uniform(-0.03, 0.03, 3)
        turn = np.array([[0, -angles[2], angles[1]], [angles[2], 0, -angles[0]], [-angles[1], angles[0], 0]])
        rotation, _ = np.linalg.qr(np.eye(3) + turn)
        rotation *= np.sign(np.diag(rotation))
        shift = rng.uniform(-reach, reach, 3) if i else np.zeros(3)
        pose = np.concatenate([rotation, shift[:, None]], axis=1)
        grey = cameras[0].grey if 0 < i <= num_alike else grey_image(rng)
        if i == 0 and num_alike:
            grey[:, : WIDTH // 2] = 60 + 5 * np.arange(WIDTH // 2)
        cameras.append(plain.Camera(calibration=calibration, pose=pose, grey=grey))
    levels = [LevelCamera(width=WIDTH, height=HEIGHT, calibration=calibration, cam_from_world=c.pose) for c in cameras]
    maps = planes_near(rng, (NUM_SOURCES, HEIGHT, WIDTH))
    maps[rng.random(maps.shape[:3]) < 0.1] = 0
    packed = np.empty((NUM_SOURCES, HEIGHT * WIDTH), np.uint32)
    for camera, out in zip(cameras[1:], packed, strict=True):
        cost.pack_neighbours(camera.grey, out)
    to_source = np.stack([warp(level, levels[0]) for level in levels[1:]])
    pose = cameras[0].pose
    centers = [pose[:, :3] @ level.center_in_world + pose[:, 3] for level in levels[1:]]
    size = WIDTH * HEIGHT
    sources = cost.Sources(
        warp=to_source,
        centers=np.array(centers, np.float32),
        texels=packed.ravel(),
        first=np.arange(NUM_SOURCES).astype(np.uint64) * np.uint64(size),
        width=np.full(NUM_SOURCES, WIDTH, np.int32),
        limit=np.tile(np.array([WIDTH - 1.01, HEIGHT - 1.01], np.float32), (NUM_SOURCES, 1)),
        planes=maps.reshape(-1, 3),
        plane_first=np.arange(NUM_SOURCES).astype(np.uint64) * np.uint64(size),
        plane_size=np.tile(np.array([WIDTH, HEIGHT], np.int32), (NUM_SOURCES, 1)),
        to_map=to_source,
        from_map=np.stack([warp(levels[0], level) for level in levels[1:]]),
    )
    reference = cost.Reference(
        padded_grey=np.pad(cameras[0].grey, cost.PADDING, mode="edge"),
        inverse_range=np.tile(np.array([0.15, 0.3], np.float32), (HEIGHT, WIDTH, 1)),
        intrinsics=np.array([45.0, 44.0, WIDTH / 2, HEIGHT / 2], np.float32),
    )
    return Scene(cameras[0], cameras[1:], maps, reference, sources)


def test_packed_neighbours_are_the_four_pixels() -> None:
    grey = grey_image(np.random.default_rng(0))
    packed = np.empty(grey.size, np.uint32)
    cost.pack_neighbours(grey, packed)
    padded = np.pad(grey, ((0, 1), (0, 1)), mode="edge")
    parts = packed.reshape(HEIGHT, WIDTH, 1).view(np.uint8).reshape(HEIGHT, WIDTH, 4)
    expected = np.stack([padded[:-1, :-1], padded[:-1, 1:], padded[1:, :-1], padded[1:, 1:]], axis=-1)
    np.testing.assert_array_equal(parts, expected)


@pytest.mark.parametrize("seed", range(3))
def test_patch_cost(seed: int) -> None:
    made = scene(seed)
    rng = np.random.default_rng(seed + 100)
    scratch = cost.new_scratch(NUM_SOURCES)
    compared = 0
    for _ in range(60):
        x, y = int(rng.integers(0, WIDTH)), int(rng.integers(0, HEIGHT))
        plane = planes_near(rng, ())
        grey = made.kernel_reference.padded_grey
        variance = cost.sample_reference(grey, x, y, WINDOW, scratch.weight, scratch.centred)
        weights = plain.patch_weights(made.reference.grey, x, y, OPTIONS.sigma_space_px, OPTIONS.sigma_grey)
        np.testing.assert_allclose(scratch.weight, weights, rtol=2e-4, atol=1e-7)
        for j, source in enumerate(made.sources):
            found = cost.view_cost(j, x, y, *plane, np.float32(variance), made.kernel_sources, WINDOW, scratch)
            if found == cost.MAX_COST:
                continue
            sigmas = OPTIONS.sigma_space_px, OPTIONS.sigma_grey
            expected = plain.patch_cost(made.reference, source, x, y, plane.astype(np.float64), *sigmas)
            assert found == pytest.approx(expected, abs=5e-3)
            compared += 1
    assert compared > 60


def test_patch_beside_the_source_image_has_the_largest_cost() -> None:
    made = scene(1)
    scratch = cost.new_scratch(NUM_SOURCES)
    cost.sample_reference(made.kernel_reference.padded_grey, 20, 16, WINDOW, scratch.weight, scratch.centred)
    near = np.float32(10.0)
    assert cost.view_cost(0, 20, 16, near, near * 0, near * 0, near, made.kernel_sources, WINDOW, scratch) == 2


@pytest.mark.parametrize("seed", range(3))
def test_reprojection_error_and_triangulation_angle(seed: int) -> None:
    made = scene(seed)
    rng = np.random.default_rng(seed + 200)
    cap, min_angle = 3.0, 0.05
    for _ in range(100):
        x, y, w = int(rng.integers(0, WIDTH)), int(rng.integers(0, HEIGHT)), rng.uniform(0.17, 0.25)
        for j, source in enumerate(made.sources):
            found = cost.geometric_error(j, x, y, np.float32(w), made.kernel_sources, np.float32(cap))
            expected = plain.reprojection_error(made.reference, source, made.maps[j].astype(float), x, y, w, cap)
            assert found == pytest.approx(expected, abs=2e-3)
            intrinsics = made.kernel_reference.intrinsics
            centers = made.kernel_sources.centers
            angle = cost.angle_factor(j, x, y, np.float32(w), centers, intrinsics, np.float32(min_angle))
            expected = plain.triangulation_factor(made.reference, source, x, y, w, min_angle)
            assert angle == pytest.approx(expected, rel=2e-3)


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


def test_credible_pixels() -> None:
    made = scene(3, reach=0.1, num_alike=2)
    rng = np.random.default_rng(10)
    plane = planes_near(rng, (HEIGHT, WIDTH))
    wanted = np.zeros((HEIGHT, WIDTH), np.bool_)
    wanted[8:-8:2, 10:-10:2] = True
    credible, rate = np.empty((HEIGHT, WIDTH), np.bool_), np.empty((HEIGHT, WIDTH), np.float32)
    max_cost, scratch = 0.6, cost.new_scratch(NUM_SOURCES)
    views = made.kernel_reference, made.kernel_sources, WINDOW, scratch
    credible_rows(0, HEIGHT, wanted, plane, np.float32(max_cost), *views, credible, rate)
    assert not credible[~wanted].any()
    sigmas = np.array([OPTIONS.sigma_space_px, OPTIONS.sigma_grey])
    expected = np.zeros_like(credible)
    for y, x in np.argwhere(wanted):
        here = plane[y, x].astype(float)
        confirming = plain.num_confirming(made.reference, made.sources, made.maps, x, y, here, max_cost, sigmas)
        expected[y, x] = confirming >= 2
    rates = [plain.px_per_inverse_depth(made.reference, source, x, y, here[0]) for source in made.sources]
    assert rate[y, x] == pytest.approx(max(rates), rel=1e-3)
    assert 5 < expected.sum() < wanted.sum() - 10
    assert np.count_nonzero(credible != expected) <= 2


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
    made = scene(0)
    settings = search.Search(
        seed=0,
        iteration=2,
        max_views=2,
        geometric_weight=np.float32(0),
        max_geometric_px=np.float32(3),
        perturbation_px=np.float32(1),
        normal_perturbation=np.float32(0.1),
        min_angle_rad=np.float32(0),
        random_depth=0,
    )
    scratch = cost.new_scratch(NUM_SOURCES)
    for _ in range(50):
        costs = rng.uniform(0, 1.6, (9, NUM_SOURCES)) * rng.uniform(0.3, 1, NUM_SOURCES)
        scratch.costs[:9] = costs
        scratch.multiplicity[:] = 1
        reference, sources = made.kernel_reference, made.kernel_sources
        count = search._select_views(5, 5, np.float32(0.2), 9, previous, reference, sources, settings, scratch)
        expected = plain.view_weights(scratch.costs[:9].astype(float), previous, 2)
        if not expected.any():
            assert count == 1
            assert scratch.chosen[0] == np.unravel_index(costs.argmin(), costs.shape)[1]
            continue
        np.testing.assert_allclose(scratch.weights, expected, rtol=1e-4)
        assert list(scratch.chosen[:count]) == list(np.argsort(-expected, kind="stable")[:count])
        assert count == min(2, np.count_nonzero(expected))
