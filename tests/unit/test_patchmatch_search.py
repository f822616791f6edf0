"""The PatchMatch back-end's sweeps against their slow plain twins: same random numbers, same planes."""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np
import pytest
from numba.core.registry import CPUDispatcher

from mvs_backends.patchmatch import kernels as search
from mvs_backends.patchmatch.cost import kernels as cost
from mvs_backends.patchmatch.maps import kernels as maps_kernels
from mvs_backends.patchmatch.planes import kernels as planes_kernels
from tests.reference import patchmatch, region_planes
from tests.reference import patchmatch_search as plain
from tests.reference.stereo_scene import HEIGHT, NUM_SOURCES, SIGMAS, WIDTH, WINDOW, wall_scene

SETTINGS = plain.Settings(
    seed=7,
    iteration=2,
    max_views=2,
    geometric_weight=0.2,
    max_geometric_px=3.0,
    perturbation_px=1.5,
    normal_perturbation=0.3,
    random_depth=1,
)
TWINS = {
    "pack_neighbours": patchmatch.packed_neighbours,
    "sample_reference": patchmatch.patch_weights,
    "view_cost": patchmatch.patch_cost,
    "geometric_error": patchmatch.reprojection_error,
    "px_per_inverse_depth": patchmatch.px_per_inverse_depth,
    "facing": patchmatch.normal_of,
    "upsample": patchmatch.upsampled,
    "smooth_rows": patchmatch.smoothed,
    "credible_rows": patchmatch.num_confirming,
    "parallax_rates": patchmatch.px_per_inverse_depth,
    "add_agreeing_rows": patchmatch.averaged,
    "random_bits": patchmatch.random_bits,
    "_gather_candidates": patchmatch.candidate_planes,
    "uniform": plain.uniform,
    "_seed": plain.first_state,
    "turned": plain.turned,
    "_merge_candidates": plain.merged,
    "_select_views": plain.chosen_views,
    "_least_cost_view": plain.chosen_views,
    "_hypothesis_cost": plain.total_cost,
    "_compare_candidates": plain.total_cost,
    "_propose": plain.proposal,
    "_update_pixel": plain.updated_pixel,
    "sweep_rows": plain.swept,
    "initialise_rows": plain.initialised,
    "_is_on": region_planes.errors_px,
    "_draw": region_planes.drawn,
    "_least_squares": region_planes.least_squares,
    "_largest_plane": region_planes.largest_plane,
    "find_planes": region_planes.owners,
    "paint_planes": region_planes.painted,
}


def for_kernels(settings: plain.Settings) -> search.Search:
    values = {name: np.float32(v) if isinstance(v, float) else v for name, v in asdict(settings).items()}
    return search.Search(**values)


def start(seed: int) -> tuple[plain.Views, plain.Maps, search.State, tuple[object, ...]]:
    """Planes near a wall, some far off: what the twins work on, the same for the kernels, and the kernels' views.

    24 x 16 pixels at the image's upper border are searched.
    """
    made, wall = wall_scene(seed)
    rng = np.random.default_rng(seed + 50)
    limits = np.zeros((HEIGHT, WIDTH, 2), np.float32)
    limits[:16, 8:32] = wall[:16, 8:32, :1] * np.array([0.8, 1.2])
    plane = wall * rng.normal(1, 0.02, (HEIGHT, WIDTH, 1)) + rng.normal(0, [0, 2e-3, 2e-3], (HEIGHT, WIDTH, 3))
    state = search.State(
        plane=plane.astype(np.float32),
        cost=rng.uniform(0, 1, (HEIGHT, WIDTH)).astype(np.float32),
        best_view=rng.integers(-1, NUM_SOURCES, (HEIGHT, WIDTH)).astype(np.int8),
    )
    views = plain.Views(made.reference, made.sources, made.maps, limits, SIGMAS)
    maps = plain.Maps(state.plane.astype(float), state.cost.astype(float), state.best_view.astype(int))
    reference = made.kernel_reference._replace(inverse_range=limits)
    return views, maps, state, (reference, made.kernel_sources, WINDOW)


def assert_alike(state: search.State, expected: plain.Maps) -> None:
    """All agrees, but for a few pixels where two planes cost the same to rounding."""
    differs = np.any(np.abs(state.plane - expected.plane) > 2e-6, axis=-1)
    differs |= (np.abs(state.cost - expected.cost) > 1e-3) | (state.best_view != expected.view)
    assert np.count_nonzero(differs) <= 8


def test_turned_planes() -> None:
    """Where the turned plane would face away or be seen at a flat angle, it stays as it was."""
    made, wall = wall_scene(0)
    rng = np.random.default_rng(1)
    num_kept = 0
    for _ in range(200):
        x, y, amount = int(rng.integers(WIDTH)), int(rng.integers(HEIGHT)), np.float32(rng.uniform(0.1, 1.5))
        plane = (wall[y, x] * [1, *rng.uniform(-10, 10, 2)]).astype(np.float32)
        state = int(rng.integers(2**63))
        found = search.turned(x, y, *plane, amount, np.uint64(state), made.kernel_reference.intrinsics)
        expected = plain.turned(made.reference, x, y, plane.astype(float), float(amount), state)
        np.testing.assert_allclose(found, expected[1:], rtol=1e-3, atol=1e-6)
        num_kept += np.array_equal(found, plane[1:])
    assert 10 < num_kept < 100


@pytest.mark.parametrize(
    ("seed", "colour", "changed"),
    [
        (0, 0, {}),
        (1, 1, {"seed": 123456789012, "iteration": 8, "max_views": 1}),
        (2, 0, {"iteration": 0, "max_views": 3, "geometric_weight": 0.0, "random_depth": 0}),
    ],
    ids=["geometric", "late", "photometric"],
)
def test_sweep(seed: int, colour: int, changed: dict[str, float]) -> None:
    settings = replace(SETTINGS, **changed)
    views, maps, state, arguments = start(seed)
    search.sweep_rows(0, HEIGHT, colour, state, *arguments, for_kernels(settings), cost.new_scratch(NUM_SOURCES))
    assert_alike(state, plain.swept(views, maps, colour, settings))
    assert np.count_nonzero(state.cost != maps.cost) > 100


@pytest.mark.parametrize(("seed", "num_random", "max_views"), [(0, 4, 2), (1, 1, 3)])
def test_start(seed: int, num_random: int, max_views: int) -> None:
    settings = replace(SETTINGS, max_views=max_views)
    views, maps, state, arguments = start(seed)
    state.plane[:, 10:20] = 0
    # Out of range, so moved to its end.
    state.plane[::3] *= 1.5
    maps.plane[:] = state.plane
    scratch = cost.new_scratch(NUM_SOURCES)
    search.initialise_rows(0, HEIGHT, num_random, state, *arguments, for_kernels(settings), scratch)
    assert_alike(state, plain.initialised(views, maps.plane, num_random, settings))


def test_every_kernel_has_a_twin() -> None:
    """Each is compared here, with other kernels in a file beside this one, or within what calls it."""
    compiled = {
        name
        for module in (cost, search, maps_kernels, planes_kernels)
        for name, kernel in vars(module).items()
        if isinstance(kernel, CPUDispatcher) and kernel.py_func.__module__ == module.__name__
    }
    assert compiled == set(TWINS)
