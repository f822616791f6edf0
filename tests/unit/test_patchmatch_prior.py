"""Planes of evenly coloured regions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mvs_backends.patchmatch.prior import even_regions, region_planes

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


def test_each_wall_gets_its_plane_in_spite_of_outliers() -> None:
    grey, truth = street()
    regions, boxes = even_regions(grey)
    assert len(boxes) == 2
    found, credible = measured(truth, 0, wrong=0.3)
    planes = region_planes(regions, boxes, found, credible, np.full(truth.shape, RATE, np.float32))
    inside = regions >= 0
    assert (planes[inside, 0] > 0).all()
    assert not planes[~inside].any()
    assert np.abs(planes[inside, 0] - truth[inside]).max() * RATE < 0.5
    slopes = np.where((np.mgrid[:80, :120][1] < 60)[..., None], LEFT[1:], RIGHT[1:])
    np.testing.assert_allclose(planes[inside, 1:], slopes[inside], atol=1e-5)


def test_pixels_that_agree_on_nothing_make_no_plane() -> None:
    grey, truth = street()
    found, credible = measured(truth, 1, wrong=1.0)
    planes = region_planes(*even_regions(grey), found, credible, np.full(truth.shape, RATE, np.float32))
    assert not planes.any()


def test_a_plane_reaches_only_as_far_as_its_points_determine_it() -> None:
    grey, truth = np.full((40, 260), 120, np.uint8), np.full((40, 260), 0.1)
    found, credible = measured(truth, 2, wrong=0.0)
    credible[:, 25:] = False
    planes = region_planes(*even_regions(grey), found, credible, np.full(truth.shape, RATE, np.float32))
    assert (planes[:, :50, 0] > 0).all()
    assert not planes[:, 250:].any()


def test_two_walls_of_one_colour_get_two_planes() -> None:
    _, truth = street()
    found, credible = measured(truth, 3, wrong=0.1)
    credible[:, 50:70] = np.random.default_rng(0).random((80, 20)) < 0.5
    even = even_regions(np.full(truth.shape, 120, np.uint8))
    planes = region_planes(*even, found, credible, np.full(truth.shape, RATE, np.float32))
    off = np.abs(planes[..., 0] - truth) * RATE
    assert np.mean(off < 0.5) > 0.9
