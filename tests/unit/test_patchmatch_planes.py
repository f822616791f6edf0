"""The kernels that find the planes of a region against their slow plain twins."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from mvs_backends.patchmatch.planes import kernels
from tests.reference import region_planes as plain

WIDTH, HEIGHT, RATE = 90, 60, 500.0


def noisy_points(seed: int, shares: list[float], count: int) -> NDArray:
    """Points on as many planes as there are shares, to half a pixel; the rest lies anywhere."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-0.5, WIDTH - 0.5, count), rng.uniform(-0.5, HEIGHT - 0.5, count)
    w, start = rng.uniform(0.02, 0.3, count), 0
    for base, share in zip((0.08, 0.15, 0.22), shares, strict=False):
        own = slice(start, start + int(share * count))
        a, b = rng.uniform(-2e-4, 2e-4, 2)
        w[own] = base + a * x[own] + b * y[own] + rng.normal(0, 0.5 / RATE, len(w[own]))
        start = own.stop
    order = rng.permutation(count)
    return np.column_stack([x, y, w, rng.uniform(0.5, 1.5, count) * RATE])[order]


def found_planes(points: NDArray, seed: int) -> tuple[int, NDArray, NDArray]:
    fits = np.zeros((kernels.MAX_PLANES, kernels.FIT_SIZE))
    owner, (left, inliers) = np.empty(len(points), np.int8), np.empty((2, len(points)), np.int64)
    return kernels.find_planes(points, seed, left, inliers, fits, owner), fits, owner


@pytest.mark.parametrize(
    ("shares", "count", "num_planes"),
    [
        ([0.9], 60, 1),
        ([0.5], 5000, 1),
        ([0.45, 0.3], 700, 2),
        ([0.5, 0.2, 0.2], 900, 3),
        ([0.3, 0.3, 0.3], 900, 0),
        ([0.8], 25, 0),
        ([], 400, 0),
    ],
    ids=["few", "thinned", "two", "three", "none has enough", "too few", "nothing"],
)
@pytest.mark.parametrize("seed", [0, 123])
def test_planes_of_points(shares: list[float], count: int, num_planes: int, seed: int) -> None:
    points = noisy_points(seed, shares, count)
    found, fits, owner = found_planes(points, seed)
    assert found == num_planes
    expected = plain.owners(points, seed)
    np.testing.assert_array_equal(owner, expected)
    rng = np.random.default_rng(seed)
    # Far beyond the points, where a plane isn't known any more.
    regions = rng.integers(6, 8, (5 * HEIGHT, 2 * WIDTH), np.int32)
    nearest = rng.integers(0, max(found, 1), regions.shape)
    planes = np.zeros((*regions.shape, 3), np.float32)
    if found:
        kernels.paint_planes(regions, 7, nearest, fits, planes)
        nearest[regions != 7] = -1
        np.testing.assert_allclose(planes, plain.painted(points, expected, nearest), rtol=1e-5)
        assert (planes[..., 0] != 0).any()
        assert count > 60 or (planes[nearest >= 0][:, 0] == 0).any()


def test_points_in_a_line_make_no_plane() -> None:
    points = noisy_points(4, [1.0], 300)
    points[:, 1] = 0.5 * points[:, 0] + 3
    found, _, owner = found_planes(points, 0)
    assert found == 0
    assert (owner == -1).all()
    np.testing.assert_array_equal(owner, plain.owners(points, 0))


@pytest.mark.parametrize(("width_px", "is_plane"), [(1e-4, False), (1.0, True)])
def test_a_strip_of_points_makes_a_plane_but_a_line_does_not(width_px: float, is_plane: bool) -> None:
    points = noisy_points(5, [1.0], 300)
    points[:, 1] = 0.5 * points[:, 0] + np.random.default_rng(0).uniform(0, width_px, 300)
    assert kernels._least_squares(points, np.arange(300), 300, np.zeros(kernels.FIT_SIZE)) == is_plane
