"""Invariants of the PatchMatch back-end on textured planes whose depth is known."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mvs_backends import get_backend
from mvs_backends.base import MvsJob, MvsOptions
from tests.reference.colmap_maps import read_map
from tests.reference.plane_scene import plane_job, true_depth

SLANTED = (0.35, -0.3, 1.0)
NUM_VIEWS = 4
SLOPES = st.floats(-0.5, 0.5).map(lambda slope: round(slope, 3))

few = settings(max_examples=5, derandomize=True, deadline=None)


def maps_of(job: MvsJob, num_threads: int = 1) -> list[NDArray[np.float32]]:
    """Each view's depth map (H, W), then each view's normal map (H, W, 3)."""
    get_backend("patchmatch").estimate(job=job, options=MvsOptions(), num_threads=num_threads)
    return [read_map(path(view)) for path in (job.depth_map_path, job.normal_map_path) for view in range(NUM_VIEWS)]


@cache
def maps_of_a_slanted_plane() -> list[NDArray[np.float32]]:
    with TemporaryDirectory() as folder:
        return maps_of(plane_job(Path(folder) / "job", normal=SLANTED))


@settings(max_examples=8, derandomize=True, deadline=None)
@given(SLOPES, SLOPES, st.integers(0, 100))
def test_depth_of_any_textured_plane_is_within_half_a_percent(across: float, down: float, seed: int) -> None:
    """At 95 % of the pixels that have one, and three in four have one."""
    normal = np.array([across, down, 1.0])
    with TemporaryDirectory() as folder:
        job = plane_job(Path(folder) / "job", normal=(across, down, 1.0), seed=seed)
        for view, depth in zip(job.views, maps_of(job), strict=False):
            known = depth > 0
            error = np.abs(depth / true_depth(view, normal / np.linalg.norm(normal), 5.0) - 1)[known]
            assert known.mean() > 0.75
            assert np.mean(error < 0.005) >= 0.95


@few
@given(st.integers(-12, 12))
def test_scaling_the_scene_scales_the_depth(doublings: int) -> None:
    """Powers of two keep every digit, so any length hidden in the search shows."""
    scale = 2.0**doublings
    with TemporaryDirectory() as folder:
        scaled = maps_of(plane_job(Path(folder) / "job", normal=SLANTED, scale=scale))
    for number, (before, after) in enumerate(zip(maps_of_a_slanted_plane(), scaled, strict=True)):
        assert before.any()
        np.testing.assert_array_equal(after, before * scale if number < NUM_VIEWS else before)


@few
@given(st.lists(st.permutations(range(NUM_VIEWS - 1)), min_size=NUM_VIEWS, max_size=NUM_VIEWS))
def test_the_order_of_source_views_does_not_matter(orders: list[list[int]]) -> None:
    with TemporaryDirectory() as folder:
        job = plane_job(Path(folder) / "job", normal=SLANTED)
        shuffled = tuple(tuple(s[i] for i in order) for s, order in zip(job.sources, orders, strict=True))
        found = maps_of(replace(job, sources=shuffled))
    np.testing.assert_equal(found, maps_of_a_slanted_plane())


@few
@given(st.integers(2, 20))
def test_the_number_of_threads_does_not_matter(num_threads: int) -> None:
    with TemporaryDirectory() as folder:
        found = maps_of(plane_job(Path(folder) / "job", normal=SLANTED), num_threads)
    np.testing.assert_equal(found, maps_of_a_slanted_plane())
