"""The searched interval of a ray holds all of the region that the ray passes."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from mvs_backends.base import MvsView
from mvs_backends.depth_range import depth_range

WIDTH, HEIGHT = 24, 16


def view_from(seed: int) -> MvsView:
    rng = np.random.default_rng(seed)
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    rotation *= np.linalg.det(rotation)
    calibration = np.array([[20.0, 0, 12.0], [0, 21.0, 8.0], [0, 0, 1.0]])
    pose = np.concatenate([rotation, rng.uniform(-6, 6, (3, 1))], axis=1)
    return MvsView(name="a", width=WIDTH, height=HEIGHT, calibration=calibration, cam_from_world=pose)


def boxes_from(seed: int, count: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    low = rng.uniform(-8, 6, (count, 3))
    return np.stack([low, low + rng.uniform(0.1, 6, (count, 3))], axis=1)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6), count=st.integers(1, 4))
def test_points_of_the_region_lie_within_their_rays_interval(seed: int, count: int) -> None:
    view, boxes = view_from(seed), boxes_from(seed + 1, count)
    entry, leave = depth_range(view, boxes, WIDTH, HEIGHT)
    # Depths along each pixel's own ray, so that points lie exactly on it.
    pixels = np.stack([*np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), np.ones((HEIGHT, WIDTH))], -1)
    rays = pixels @ np.linalg.inv(view.calibration).T
    for depth in np.random.default_rng(seed + 2).uniform(0.01, 25, 40):
        points = (rays * depth - view.cam_from_world[:, 3]) @ view.cam_from_world[:, :3]
        inside = np.any(
            [np.all((points > low) & (points < high), axis=-1) for low, high in boxes],
            axis=0,
        )
        assert np.all(entry[inside] <= depth + 1e-9)
        assert np.all(leave[inside] >= depth - 1e-9)
    assert np.all(entry <= leave)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6))
def test_ends_of_the_interval_lie_on_the_box(seed: int) -> None:
    view, boxes = view_from(seed), boxes_from(seed + 1, 1)
    entry, leave = depth_range(view, boxes, WIDTH, HEIGHT)
    pixels = np.stack([*np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), np.ones((HEIGHT, WIDTH))], -1)
    rays = pixels @ np.linalg.inv(view.calibration).T
    hit = leave > 0
    for depth in (entry, leave):
        points = (rays * depth[..., None] - view.cam_from_world[:, 3]) @ view.cam_from_world[:, :3]
        low, high = boxes[0]
        assert np.all(points[hit] >= low - 1e-6)
        assert np.all(points[hit] <= high + 1e-6)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6), scale=st.floats(0.01, 100))
def test_scaling_the_world_scales_the_interval(seed: int, scale: float) -> None:
    view, boxes = view_from(seed), boxes_from(seed + 1, 2)
    entry, leave = depth_range(view, boxes, WIDTH, HEIGHT)
    pose = view.cam_from_world.copy()
    pose[:, 3] *= scale
    scaled = MvsView(name="a", width=WIDTH, height=HEIGHT, calibration=view.calibration, cam_from_world=pose)
    scaled_entry, scaled_leave = depth_range(scaled, boxes * scale, WIDTH, HEIGHT)
    np.testing.assert_allclose(scaled_entry, entry * scale, rtol=1e-6, atol=1e-9 * scale)
    np.testing.assert_allclose(scaled_leave, leave * scale, rtol=1e-6, atol=1e-9 * scale)


def test_reduced_images_have_the_same_rays() -> None:
    view, boxes = view_from(3), np.array([[[-20.0, -20, -20], [20, 20, 20]]])
    entry, leave = depth_range(view, boxes, WIDTH, HEIGHT)
    _, half = depth_range(view, boxes, WIDTH // 2, HEIGHT // 2)
    blocks = leave.reshape(HEIGHT // 2, 2, WIDTH // 2, 2)
    assert np.all(half <= blocks.max(axis=(1, 3)) * 1.05)
    assert np.all(half >= blocks.min(axis=(1, 3)) * 0.95)
    assert not entry.any()
