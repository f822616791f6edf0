"""What must hold for any points, rays and lines of sight."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from app.occlusion.solid_columns import SolidColumns, solid_columns

many = settings(max_examples=60, derandomize=True, deadline=None)
seeds = st.integers(0, 10_000)
BOUNDS_M = np.array([[-5.0, 3.0], [12.0, 15.0]])


def _input(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Points, rays (point and camera), and cameras; some of everything outside the rectangle."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-8, 0, 0], [15, 18, 9], (60, 3))
    cameras = rng.uniform([-8, 0, 1], [15, 18, 3], (12, 3))
    return points, rng.integers(0, 60, 80), cameras[rng.integers(0, 12, 80)], cameras


def _solid(points: np.ndarray, rows: np.ndarray, centers: np.ndarray) -> SolidColumns:
    rays = np.arange(len(rows))
    return solid_columns(points, centers, ray_points=rows, ray_centers=rays, bounds_m=BOUNDS_M, column_m=1.3)


def _left(solid: SolidColumns, cameras: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N, P) which points are seen, of all."""
    bits = np.full((len(cameras), -(-len(points) // 64)), np.iinfo(np.uint64).max, np.uint64)
    left = solid.remove_hidden(bits, cameras, points)
    flat = np.unpackbits(left.astype("<u8").view(np.uint8), axis=1, bitorder="little")
    return flat[:, : len(points)].astype(bool)


@many
@given(seeds, st.integers(0, 80))
def test_more_rays_never_hide_more(seed: int, num_rays: int) -> None:
    points, rows, centers, cameras = _input(seed)
    few = _left(_solid(points, rows[:num_rays], centers[:num_rays]), cameras, points)
    assert not np.any(few & ~_left(_solid(points, rows, centers), cameras, points))


@many
@given(seeds)
def test_the_order_of_points_and_rays_does_not_matter(seed: int) -> None:
    points, rows, centers, cameras = _input(seed)
    rng = np.random.default_rng(seed)
    order, ray_order = rng.permutation(len(points)), rng.permutation(len(rows))
    rank = np.argsort(order)
    shuffled = _solid(points[order], rank[rows][ray_order], centers[ray_order])
    solid = _solid(points, rows, centers)
    np.testing.assert_array_equal(shuffled.tops_m, solid.tops_m)
    np.testing.assert_array_equal(_left(shuffled, cameras, points[order])[:, rank], _left(solid, cameras, points))


@many
@given(seeds)
def test_only_points_that_were_in_the_image_are_seen(seed: int) -> None:
    points, rows, centers, cameras = _input(seed)
    solid = _solid(points, rows, centers)
    seen = np.random.default_rng(seed).integers(0, 2**60, (len(cameras), 1), dtype=np.uint64)
    left = solid.remove_hidden(seen, cameras, points)
    assert not np.any(left & ~seen)
    np.testing.assert_array_equal(solid.leave_any(seen, cameras, points), np.any(left, axis=1))
