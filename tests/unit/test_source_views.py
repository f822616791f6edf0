"""Which other images a reference view's depth is searched in."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mvs_backends.base import MvsView
from mvs_backends.depth_range import usable_views
from mvs_backends.source_views import choose_source_views
from tests.reference.plane_scene import plane_job

CALIBRATION = np.array([[100.0, 0, 50], [0, 100.0, 40], [0, 0, 1]])


def view_at(x: float, z: float = 0.0, *, backwards: bool = False) -> MvsView:
    """A camera at (x, 0, z) that looks along +z, or along -z."""
    rotation = np.diag([-1.0, 1.0, -1.0]) if backwards else np.eye(3)
    pose = np.concatenate([rotation, -rotation @ np.array([[x], [0.0], [z]])], axis=1)
    return MvsView(name=f"{x}_{z}_{backwards}", width=100, height=80, calibration=CALIBRATION, cam_from_world=pose)


def wall(seed: int = 0, count: int = 300) -> np.ndarray:
    """Points 10 in front of the cameras."""
    rng = np.random.default_rng(seed)
    return np.stack([rng.uniform(-3, 3, count), rng.uniform(-2, 2, count), np.full(count, 10.0)], axis=1)


def choose(views: list[MvsView], *, points: bool = True, samples: bool = True, max_sources: int = 10):
    surface = wall()
    none = np.zeros((0, 3))
    return choose_source_views(
        views=views,
        points_in_world=surface[:50] if points else none,
        point_views=[np.arange(50) if points else np.zeros(0, np.int64) for _ in views],
        samples_in_world=surface[50:] if samples else none,
        max_sources=max_sources,
    )


@pytest.mark.parametrize(("points", "samples"), [(True, False), (False, True), (True, True)])
def test_good_angle_comes_before_narrow_and_wide(points: bool, samples: bool) -> None:
    views = [view_at(0), view_at(0.02), view_at(1.4), view_at(3.0)]
    assert choose(views, points=points, samples=samples)[0] == (2, 3, 1)


def test_same_image_scale_comes_before_another() -> None:
    views = [view_at(0), view_at(1.4, z=-20), view_at(1.4)]
    assert choose(views, samples=False)[0][0] == 2


def test_views_without_common_surface_are_left_out() -> None:
    views = [view_at(0), view_at(1.4), view_at(1.4, backwards=True)]
    assert choose(views, points=False) == ((1,), (0,), ())


def test_only_the_best_are_kept() -> None:
    views = [view_at(x) for x in np.linspace(0, 3, 8)]
    chosen, best = choose(views), choose(views, max_sources=2)
    assert [c[:2] for c in chosen] == list(best)
    assert all(i not in c for i, c in enumerate(chosen))


def test_order_of_points_does_not_matter() -> None:
    views = [view_at(x) for x in np.linspace(0, 3, 6)]
    surface = wall()
    turned = choose_source_views(
        views=views,
        points_in_world=surface[:50][::-1],
        point_views=[np.arange(50)] * 6,
        samples_in_world=surface[50:][::-1],
        max_sources=10,
    )
    assert turned == choose(views)


def test_nothing_to_share_gives_no_sources() -> None:
    assert choose([view_at(0), view_at(1)], points=False, samples=False) == ((), ())


def test_views_that_cannot_be_used_are_no_sources_either(tmp_path: Path) -> None:
    """View 3 looks away from the region, so view 2, which has no other source, is of no use, nor is it to view 1."""
    job = plane_job(tmp_path / "job", normal=(0.0, 0.0, 1.0))
    away = job.views[3].cam_from_world * np.array([[-1.0], [1.0], [-1.0]])
    job = replace(
        job,
        views=(*job.views[:3], replace(job.views[3], cam_from_world=away)),
        sources=((1, 3), (3, 2, 0), (3,), (0, 1)),
    )
    assert usable_views(job) == {0: (1,), 1: (0,)}
