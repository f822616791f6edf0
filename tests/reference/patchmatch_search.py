"""Slow plain twins of the search of the PatchMatch back-end, pixel by pixel, with the same random numbers."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tests.reference import patchmatch as plain
from tests.reference.patchmatch import MASK, Array, Camera

MIN_VARIANCE, MIN_FACING = 2.0, 0.1


@dataclass
class Settings:
    """What steers a sweep; see the fields of the same names in `mvs_backends.patchmatch.kernels.Search`."""

    seed: int
    iteration: int
    max_views: int
    geometric_weight: float
    max_geometric_px: float
    perturbation_px: float
    normal_perturbation: float
    random_depth: int


@dataclass
class Views:
    """What a search works on."""

    reference: Camera
    sources: list[Camera]
    maps: NDArray[np.float32]
    """(N, H, W, 3) the sources' planes."""
    limits: NDArray[np.float32]
    """(H, W, 2) smallest and largest inverse depth."""
    sigmas: tuple[float, float]

    def cost(self, j: int, x: int, y: int, plane: Array) -> float:
        """Cost of a plane in source view j."""
        return plain.patch_cost(self.reference, self.sources[j], x, y, plane, self.sigmas)

    def is_textured(self, x: int, y: int) -> bool:
        """Whether a pixel's window tells anything."""
        return plain.patch_variance(self.reference.grey, x, y, self.sigmas) >= MIN_VARIANCE

    def rate(self, x: int, y: int, w: float) -> float:
        """Pixels per inverse depth in the source view where they are most."""
        return max(plain.px_per_inverse_depth(self.reference, source, x, y, w) for source in self.sources)


@dataclass
class Maps:
    """What a search changes: planes (H, W, 3), costs (H, W), most important views (H, W)."""

    plane: Array
    cost: Array
    view: NDArray[np.int64]

    def copy(self) -> Maps:
        return Maps(self.plane.copy(), self.cost.copy(), self.view.copy())


def first_state(seed: int, iteration: int, pixel: int) -> int:
    """Where a pixel's random numbers begin."""
    return plain.random_bits((seed * 0x9E3779B97F4A7C15 + iteration * 0xD1B54A32D192ED03 + pixel + 1) & MASK)


def next_state(state: int) -> int:
    """The next of a pixel's random numbers."""
    return plain.random_bits((state + 0x9E3779B97F4A7C15) & MASK)


def uniform(state: int) -> float:
    """[0, 1) from the upper 24 bits."""
    return (state >> 40) / 2**24


def turned(camera: Camera, x: int, y: int, plane: Array, amount: float, state: int) -> Array:
    """The plane whose unit normal is `plane`'s with a random vector added, through the same point.

    The same plane where the camera would see it from behind or at a flat angle.
    """
    ray = np.linalg.inv(camera.calibration) @ [x, y, 1.0]
    normal = -plain.normal_of(camera, x, y, plane)
    for axis in range(3):
        state = plain.random_bits(state)
        normal[axis] += amount * (2 * uniform(state) - 1)
    if normal @ ray < MIN_FACING * np.linalg.norm(normal) * np.linalg.norm(ray):
        return plane
    per_pixel = np.linalg.inv(camera.calibration)[:, :2].T @ normal
    return np.array([plane[0], *(plane[0] * per_pixel / (normal @ ray))])


def merged(candidates: Array, rate: float) -> tuple[Array, NDArray[np.int64]]:
    """Candidates without those that move no sample by a tenth of a pixel against an earlier one, and their numbers."""
    kept: list[Array] = []
    counts: list[int] = []
    for candidate in candidates:
        for k, other in enumerate(kept):
            w, a, b = np.abs(candidate - other)
            if (w + 5 * (a + b)) * rate < 0.1:
                counts[k] += 1
                break
        else:
            kept.append(candidate)
            counts.append(1)
    return np.array(kept), np.array(counts)


def chosen_views(costs: Array, previous: int, settings: Settings) -> Array:
    """(N,) the views' weights, all but the largest `max_views` set to 0; costs (C, N) of hypotheses in views."""
    weights = plain.view_weights(costs, previous, settings.iteration)
    order = np.argsort(-weights, kind="stable")
    weights[weights <= 1e-6] = 0
    weights[order[settings.max_views :]] = 0
    if not weights.any():
        weights[np.argmin(costs.min(axis=0))] = 1
    return weights


def total_cost(views: Views, x: int, y: int, w: float, costs: Array, weights: Array, settings: Settings) -> float:
    """Weighted mean over the chosen views of the photometric cost and the reprojection error."""
    total = 0.0
    for j in np.flatnonzero(weights):
        error = plain.reprojection_error(
            views.reference, views.sources[j], views.maps[j].astype(float), x, y, w, settings.max_geometric_px
        )
        total += weights[j] * (costs[j] + settings.geometric_weight * error)
    return float(total / weights.sum())


def proposal(
    views: Views, maps: Maps, x: int, y: int, best: Array, kind: int, rate: float, draw: int, settings: Settings
) -> Array | None:
    """Refinement number `kind` of a pixel's best plane; none if it's out of range or hardly faces the camera.

    0: the slopes of the neighbours' depths; 1: another depth; 2: another normal; 3: both; 4: anything.
    """
    height, width = maps.cost.shape
    low, high = views.limits[y, x].astype(float)
    amount, later = settings.normal_perturbation, plain.random_bits(draw)
    nearer = best * (1 + settings.perturbation_px * (2 * uniform(draw) - 1) ** 3 / rate / best[0])
    if kind == 0:
        if not (0 < x < width - 1 and 0 < y < height - 1):
            return None
        w = maps.plane[..., 0]
        found = np.array([best[0], (w[y, x + 1] - w[y, x - 1]) / 2, (w[y + 1, x] - w[y - 1, x]) / 2])
    elif kind == 1:
        found = nearer
    elif kind == 2:
        found = turned(views.reference, x, y, best, amount, draw)
    elif kind == 3:
        found = turned(views.reference, x, y, nearer, amount, later)
    elif settings.random_depth:
        found = turned(views.reference, x, y, best * (low + (high - low) * uniform(draw)) / best[0], 1.0, later)
    else:
        return None
    ray = np.linalg.inv(views.reference.calibration) @ [x, y, 1.0]
    facing = -plain.normal_of(views.reference, x, y, found) @ ray / np.linalg.norm(ray)
    return found if low <= found[0] <= high and facing > MIN_FACING else None


def updated_pixel(views: Views, maps: Maps, x: int, y: int, settings: Settings) -> tuple[Array, float, int]:
    """Plane, cost and most important view of a textured pixel after one step of the search."""
    candidates = plain.candidate_planes(maps.plane, maps.cost, views.limits, x, y)
    own = candidates[0, 0]
    rate = views.rate(x, y, own)
    candidates, counts = merged(candidates, rate)
    costs = np.array([[views.cost(j, x, y, c) for j in range(len(views.sources))] for c in candidates])
    repeated = np.repeat(costs, counts, axis=0)
    weights = chosen_views(repeated, int(maps.view[y, x]), settings)
    totals = [total_cost(views, x, y, c[0], row, weights, settings) for c, row in zip(candidates, costs, strict=True)]
    best, least = candidates[np.argmin(totals)], min(totals)
    draw = first_state(settings.seed, settings.iteration, y * maps.cost.shape[1] + x)
    for kind in range(5):
        draw = next_state(draw)
        trial = proposal(views, maps, x, y, best, kind, rate, draw, settings)
        if trial is None:
            continue
        row = np.array([views.cost(j, x, y, trial) if weights[j] else 0.0 for j in range(len(views.sources))])
        cost = total_cost(views, x, y, trial[0], row, weights, settings)
        if cost < least:
            best, least = trial, cost
    return best, least, int(np.argmax(weights))


def swept(views: Views, maps: Maps, colour: int, settings: Settings) -> Maps:
    """Maps after a step at all textured pixels of one checkerboard colour that are searched."""
    result = maps.copy()
    for y, x in np.ndindex(maps.cost.shape):
        if (x + y) % 2 == colour and views.limits[y, x, 1] > 0 and views.is_textured(x, y):
            result.plane[y, x], result.cost[y, x], result.view[y, x] = updated_pixel(views, maps, x, y, settings)
    return result


def initialised(views: Views, plane: Array, num_random: int, settings: Settings) -> Maps:
    """The best of each pixel's plane, where it has one, and random ones, by the mean over its better views."""
    height, width = plane.shape[:2]
    kept = min(settings.max_views, len(views.sources))
    result = Maps(np.zeros((height, width, 3)), np.full((height, width), 2.0), np.full((height, width), -1))
    for y, x in np.ndindex(height, width):
        low, high = views.limits[y, x].astype(float)
        if high <= 0:
            continue
        textured = views.is_textured(x, y)
        draw = first_state(settings.seed, -1, y * width + x)
        least = math.inf
        for i in range(num_random + 1):
            draw = next_state(draw)
            trial = plane[y, x].astype(float)
            if i == 0:
                if trial[0] <= 0:
                    continue
                trial[0] = min(max(trial[0], low), high)
            else:
                # One in each of as many equal parts of the interval.
                w = low + (high - low) * (i - 1 + uniform(draw)) / num_random
                level = np.array([w, 0.0, 0.0])
                trial = turned(views.reference, x, y, level, 0.7, plain.random_bits(draw))
            costs = [views.cost(j, x, y, trial) if textured else 2.0 for j in range(len(views.sources))]
            cost = float(np.mean(sorted(costs)[:kept]))
            if cost < least:
                least = cost
                result.plane[y, x], result.cost[y, x] = trial, cost
    return result
