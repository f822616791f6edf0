"""Planes of evenly coloured regions."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from mvs_backends.patchmatch import prior
from mvs_backends.patchmatch.geometry import LevelCamera
from mvs_backends.patchmatch.options import PatchMatchOptions
from mvs_backends.patchmatch.prior import even_regions, points_in_image, region_planes
from mvs_backends.patchmatch.search import Hypotheses, LevelSearch
from tests.reference.stereo_scene import HEIGHT, WIDTH, WINDOW, wall_scene

RATE = 600.0
LEFT, RIGHT = np.array([0.1, 2e-4, -1e-4]), np.array([0.05, -1e-4, 2e-4])


def street() -> tuple[NDArray, NDArray]:
    """Grey values of two walls that meet in a dark line at column 60, and the inverse depth of each pixel.

    |  wall  |#|  wall  |
    | 120    |#|   180  |
    """
    y, x = np.mgrid[:80, :120]
    truth = np.where(x < 60, *(plane[0] + plane[1] * x + plane[2] * y for plane in (LEFT, RIGHT)))
    grey = np.where(x < 60, 120, 180).astype(np.uint8)
    grey[:, 59:61] = 20
    return grey, truth


def measured(truth: NDArray, seed: int, wrong: float) -> tuple[NDArray, NDArray]:
    """Inverse depths with noise of a third of a pixel, known near the upper and left borders; some far off."""
    rng = np.random.default_rng(seed)
    found = truth + rng.normal(0, 0.3 / RATE, truth.shape)
    far_off = rng.random(truth.shape) < wrong
    found[far_off] *= rng.uniform(0.3, 2, far_off.sum())
    credible = rng.random(truth.shape) < 0.5
    credible[20:, 20:55] = credible[20:, 80:] = False
    return found.astype(np.float32), credible


def planes_of(regions: NDArray, boxes: list, found: NDArray, credible: NDArray) -> NDArray:
    """The planes of regions from the credible of the found inverse depths."""
    y, x = np.nonzero(credible)
    points = np.stack([x, y, found[y, x]], axis=1).astype(np.float32)
    with ThreadPoolExecutor(2) as executor:
        return region_planes(regions, boxes, points, np.full(len(points), RATE, np.float32), executor)


def test_each_wall_gets_its_plane_in_spite_of_outliers() -> None:
    grey, truth = street()
    regions, boxes = even_regions(grey)
    assert len(boxes) == 2
    found, credible = measured(truth, 0, wrong=0.3)
    planes = planes_of(regions, boxes, found, credible)
    inside = regions >= 0
    assert (planes[inside, 0] > 0).all()
    assert not planes[~inside].any()
    assert np.abs(planes[inside, 0] - truth[inside]).max() * RATE < 0.5
    slopes = np.where((np.mgrid[:80, :120][1] < 60)[..., None], LEFT[1:], RIGHT[1:])
    np.testing.assert_allclose(planes[inside, 1:], slopes[inside], atol=1e-5)


def test_pixels_that_agree_on_nothing_make_no_plane() -> None:
    grey, truth = street()
    found, credible = measured(truth, 1, wrong=1.0)
    planes = planes_of(*even_regions(grey), found, credible)
    assert not planes.any()


def test_a_plane_reaches_only_as_far_as_its_points_determine_it() -> None:
    grey, truth = np.full((40, 260), 120, np.uint8), np.full((40, 260), 0.1)
    found, credible = measured(truth, 2, wrong=0.0)
    credible[:, 25:] = False
    planes = planes_of(*even_regions(grey), found, credible)
    assert (planes[:, :50, 0] > 0).all()
    assert not planes[:, 250:].any()


def test_two_walls_of_one_colour_get_two_planes() -> None:
    _, truth = street()
    found, credible = measured(truth, 3, wrong=0.1)
    credible[:, 50:70] = np.random.default_rng(0).random((80, 20)) < 0.5
    even = even_regions(np.full(truth.shape, 120, np.uint8))
    planes = planes_of(*even, found, credible)
    off = np.abs(planes[..., 0] - truth) * RATE
    assert np.mean(off < 0.5) > 0.9


def test_points_of_one_view_in_the_image_of_another() -> None:
    rng = np.random.default_rng(4)
    turn = np.array([[0.9986295, 0, 0.0523360], [0, 1, 0], [-0.0523360, 0, 0.9986295]])
    source = LevelCamera(
        width=60,
        height=40,
        calibration=np.array([[50.0, 0, 29.5], [0, 50.0, 19.5], [0, 0, 1]]),
        cam_from_world=np.eye(3, 4),
    )
    other = LevelCamera(
        width=120,
        height=80,
        calibration=np.array([[100.0, 0, 59.5], [0, 100.0, 39.5], [0, 0, 1]]),
        cam_from_world=np.concatenate([turn, [[0.5], [0.1], [-0.3]]], axis=1),
    )
    plane = np.zeros((40, 60, 3), np.float32)
    plane[..., 0] = rng.uniform(0.1, 0.3, (40, 60))
    chosen = rng.random((40, 60)) < 0.3
    expected = []
    for y, x in np.argwhere(chosen):
        in_source = np.linalg.inv(source.calibration) @ [x, y, 1] / plane[y, x, 0]
        in_other = turn @ in_source + other.cam_from_world[:, 3]
        column, row, _ = other.calibration @ in_other / in_other[2]
        if -0.5 <= column < 119.5 and -0.5 <= row < 79.5:
            expected.append((column, row, 1 / in_other[2]))
    assert 50 < len(expected) < chosen.sum()
    np.testing.assert_allclose(points_in_image(plane, chosen, source, other), expected, rtol=1e-4, atol=1e-3)
    assert not len(points_in_image(plane, chosen, other, replace(source, cam_from_world=-np.eye(3, 4))))


def test_very_many_points_of_a_view_are_thinned_evenly(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = LevelCamera(width=60, height=40, calibration=np.diag([50.0, 50, 1]), cam_from_world=np.eye(3, 4))
    plane = np.full((40, 60, 3), 0.2, np.float32)
    monkeypatch.setattr(prior, "_MAX_POINTS_OF_VIEW", 100)
    points = points_in_image(plane, np.ones((40, 60), np.bool_), camera, camera)
    assert 50 < len(points) <= 100
    assert np.ptp(points[:, 1]) > 35


def test_credible_pixels_keep_their_hypotheses_and_others_get_the_plane() -> None:
    made, wall = wall_scene(5)
    rng = np.random.default_rng(5)
    flat = made.kernel_reference._replace(padded_grey=np.full_like(made.kernel_reference.padded_grey, 128))
    credible = rng.random((HEIGHT, WIDTH)) < 0.3
    found = Hypotheses(
        plane=(wall * 1.05).astype(np.float32),
        cost=np.full((HEIGHT, WIDTH), 1.5, np.float32),
        view=np.zeros((HEIGHT, WIDTH), np.int8),
    )
    y, x = np.nonzero(credible)
    points = np.stack([x, y, wall[y, x, 0]], axis=1).astype(np.float32)
    with ThreadPoolExecutor(1) as executor:
        search = LevelSearch(
            reference=flat,
            sources=made.kernel_sources,
            window=WINDOW,
            options=PatchMatchOptions(),
            seed=0,
            executor=executor,
        )
        result = search.with_planes(found, credible, points)
    np.testing.assert_array_equal(result.plane[credible], found.plane[credible])
    np.testing.assert_array_equal(result.cost[credible], found.cost[credible])
    np.testing.assert_allclose(result.plane[~credible], wall[~credible], atol=1e-5)
    assert (result.cost[~credible] < PatchMatchOptions().max_cost).all()
