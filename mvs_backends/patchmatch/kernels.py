"""Compiled search for the plane of each pixel: start, propagation, view selection, refinement.

Works on planes as `cost/kernels.py` defines them, after ACMM (Xu & Tao 2019). Random numbers depend on seed, sweep and
pixel only, so that neither threads nor the order of pixels matter.
"""

# Kernels are typed by what they are called with.
# mypy: disable-error-code="no-untyped-def, untyped-decorator, no-untyped-call, no-any-return"

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mvs_backends.patchmatch.cost.kernels import (
    COMPILED,
    MAX_COST,
    MIN_VARIANCE,
    facing,
    geometric_error,
    px_per_inverse_depth,
    sample_reference,
    view_cost,
)

_ZERO = np.float32(0)
_HALF = np.float32(0.5)
_ONE = np.float32(1)
_TWO = np.float32(2)
_TINY = np.float32(1e-12)
_NUM_AREAS = 8
_MIN_FACING = np.float32(0.1)
_GOOD_COST = np.float32(0.8)
_GOOD_COST_DECAY = np.float32(90)
_BAD_COST = np.float32(1.2)
_MIN_GOOD = 2
_MAX_BAD = 3
_TWO_BETA_SQUARED = np.float32(2 * 0.3 * 0.3)
_UNIT = np.float32(1.0 / 16777216.0)
_RING_X = np.array(
    [[0, -1, 1, -2, 2, -3, 3], [0, -1, 1, -2, 2, -3, 3], [-1, -2, -2, -3, -3, -4, -4], [1, 2, 2, 3, 3, 4, 4]]
)
_RING_Y = np.array(
    [[-1, -2, -2, -3, -3, -4, -4], [1, 2, 2, 3, 3, 4, 4], [0, -1, 1, -2, 2, -3, 3], [0, -1, 1, -2, 2, -3, 3]]
)
_STRIP_X = np.array([0, 0, -1, 1])
_STRIP_Y = np.array([-1, 1, 0, 0])
_STRIP_FIRST, _STRIP_STEP, _STRIP_LENGTH = 3, 2, 11


class State(NamedTuple):
    """What a sweep changes."""

    plane: NDArray[np.float32]
    """(H, W, 3) w, a, b."""
    cost: NDArray[np.float32]
    """(H, W) aggregated cost of `plane`, [0, 2] plus the geometric term."""
    best_view: NDArray[np.int8]
    """(H, W) most important source view of the last sweep; -1: none yet."""


class Search(NamedTuple):
    """Numbers that steer a sweep."""

    seed: int
    iteration: int
    """Counts on over the sweeps of a level; alters the random numbers and tightens the thresholds."""
    max_views: int
    """Views that the cost of a hypothesis is averaged over, at most."""
    geometric_weight: np.float32
    """lambda of ACMM; 0 in a photometric pass."""
    max_geometric_px: np.float32
    """delta of ACMM."""
    perturbation_px: np.float32
    """Largest shift of a refined hypothesis in the source view."""
    normal_perturbation: np.float32
    """Largest change of each component of a refined unit normal."""
    random_depth: int
    """1: also try a hypothesis from the whole interval."""


@njit(forceinline=True, **COMPILED)
def random_bits(state: np.uint64) -> np.uint64:
    """The finaliser of splitmix64 (Steele, Lea & Flood 2014)."""
    state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return state ^ (state >> np.uint64(31))


@njit(forceinline=True, **COMPILED)
def uniform(state: np.uint64) -> np.float32:
    """A number in [0, 1), from the upper 24 bits."""
    return np.float32(np.int32(state >> np.uint64(40))) * _UNIT


@njit(forceinline=True, **COMPILED)
def _seed(seed: int, iteration: int, pixel: int) -> np.uint64:
    return random_bits(
        np.uint64(seed) * np.uint64(0x9E3779B97F4A7C15)
        + np.uint64(iteration) * np.uint64(0xD1B54A32D192ED03)
        + np.uint64(pixel + 1)
    )


@njit(forceinline=True, **COMPILED)
def turned(x, y, w, a, b, amount, state, intrinsics):
    """Slopes of the plane (w, a, b) of pixel (x, y) after its unit normal is changed, the point at the pixel kept.

    Up to `amount` is added to each component. The slopes stay as they are if the plane would face away or be seen at a
    cosine of less than 0.1. `intrinsics`: (4,) fx, fy, cx, cy in pixels.
    """
    fx, fy = intrinsics[0], intrinsics[1]
    rx, ry = (np.float32(x) - intrinsics[2]) / fx, (np.float32(y) - intrinsics[3]) / fy
    nx, ny = a * fx, b * fy
    nz = w - nx * rx - ny * ry
    scale = _ONE / np.sqrt(nx * nx + ny * ny + nz * nz)
    s1 = random_bits(state)
    s2 = random_bits(s1)
    s3 = random_bits(s2)
    nx = nx * scale + amount * (_TWO * uniform(s1) - _ONE)
    ny = ny * scale + amount * (_TWO * uniform(s2) - _ONE)
    nz = nz * scale + amount * (_TWO * uniform(s3) - _ONE)
    along = nx * rx + ny * ry + nz
    ratio = along / np.sqrt((nx * nx + ny * ny + nz * nz) * (rx * rx + ry * ry + _ONE))
    if ratio < _MIN_FACING:
        return a, b
    return w * nx / (fx * along), w * ny / (fy * along)


@njit(forceinline=True, **COMPILED)
def _gather_candidates(x, y, state, low, high, scratch):
    """Adaptive checkerboard sampling (ACMM): the best hypothesis of each of 8 areas, moved here.

    Row 0 of `candidates` (9, 3) is the pixel's own. Returns how many rows are filled.
    """
    candidates = scratch.candidates
    height, width = state.cost.shape
    candidates[0, 0], candidates[0, 1], candidates[0, 2] = (
        state.plane[y, x, 0],
        state.plane[y, x, 1],
        state.plane[y, x, 2],
    )
    count = 1
    for area in range(_NUM_AREAS):
        best, best_x, best_y = np.float32(1e9), -1, -1
        side = area & 3
        length = 7 if area < 4 else _STRIP_LENGTH
        for i in range(length):
            if area < 4:
                nx, ny = x + _RING_X[side, i], y + _RING_Y[side, i]
            else:
                step = _STRIP_FIRST + _STRIP_STEP * i
                nx, ny = x + step * _STRIP_X[side], y + step * _STRIP_Y[side]
            if 0 <= nx < width and 0 <= ny < height and state.cost[ny, nx] < best:
                best, best_x, best_y = state.cost[ny, nx], nx, ny
        if best_x < 0:
            continue
        a, b = state.plane[best_y, best_x, 1], state.plane[best_y, best_x, 2]
        w = state.plane[best_y, best_x, 0] + a * np.float32(x - best_x) + b * np.float32(y - best_y)
        if w < low or w > high:
            continue
        candidates[count, 0], candidates[count, 1], candidates[count, 2] = w, a, b
        count += 1
    return count


@njit(forceinline=True, **COMPILED)
def _merge_candidates(count, rate, scratch):
    """Drop candidates that move no sample of the window by a tenth of a pixel against an earlier one; count them."""
    candidates, multiplicity = scratch.candidates, scratch.multiplicity
    kept = 1
    multiplicity[0] = 1
    for i in range(1, count):
        twin = -1
        for k in range(kept):
            shift = abs(candidates[i, 0] - candidates[k, 0]) + np.float32(5) * (
                abs(candidates[i, 1] - candidates[k, 1]) + abs(candidates[i, 2] - candidates[k, 2])
            )
            if shift * rate < np.float32(0.1):
                twin = k
                break
        if twin >= 0:
            multiplicity[twin] += 1
            continue
        candidates[kept, 0], candidates[kept, 1], candidates[kept, 2] = (
            candidates[i, 0],
            candidates[i, 1],
            candidates[i, 2],
        )
        multiplicity[kept] = 1
        kept += 1
    return kept


@njit(forceinline=True, **COMPILED)
def _least_cost_view(count, num_views, costs):
    best, best_cost = 0, np.float32(1e9)
    for j in range(num_views):
        for i in range(count):
            if costs[i, j] < best_cost:
                best, best_cost = j, costs[i, j]
    return best


@njit(forceinline=True, **COMPILED)
def _select_views(count, previous, search, scratch):
    """Multi-hypothesis joint view selection (ACMM).

    Writes the views' weights and the best of them, best first, into scratch. Returns how many are chosen, at least one.
    """
    costs, multiplicity, weights, chosen = scratch.costs, scratch.multiplicity, scratch.weights, scratch.chosen
    num_views = len(weights)
    sweep = np.float32(search.iteration)
    good_cost = _GOOD_COST * np.exp(-sweep * sweep / _GOOD_COST_DECAY)
    for j in range(num_views):
        good, bad, confidence = 0, 0, _ZERO
        for i in range(count):
            cost = costs[i, j]
            if cost < good_cost:
                good += multiplicity[i]
                confidence += np.float32(multiplicity[i]) * np.exp(-cost * cost / _TWO_BETA_SQUARED)
            elif cost > _BAD_COST:
                bad += multiplicity[i]
        weights[j] = _ZERO
        if good > _MIN_GOOD and bad < _MAX_BAD:
            weights[j] = confidence / np.float32(good)
            if j == previous:
                weights[j] *= _TWO
        elif j == previous:
            weights[j] = np.float32(0.2)
    num_chosen = 0
    for k in range(min(search.max_views, num_views)):
        best, best_weight = -1, np.float32(1e-6)
        for j in range(num_views):
            taken = False
            for i in range(k):
                taken = taken or chosen[i] == j
            if not taken and weights[j] > best_weight:
                best, best_weight = j, weights[j]
        if best < 0:
            break
        chosen[k] = best
        num_chosen += 1
    if num_chosen == 0:
        chosen[0] = _least_cost_view(count, num_views, costs)
        weights[chosen[0]] = _ONE
        num_chosen = 1
    return num_chosen


@njit(forceinline=True, **COMPILED)
def _hypothesis_cost(x, y, plane, variance, bound, num_chosen, sources, window, search, scratch):
    """Weighted cost over the chosen views, or something at least `bound` as soon as it can't be less."""
    weights, chosen = scratch.weights, scratch.chosen
    total = _ZERO
    for k in range(num_chosen):
        total += weights[chosen[k]]
    stop = bound * total
    cost = _ZERO
    for k in range(num_chosen):
        j = chosen[k]
        one = view_cost(j, x, y, plane[0], plane[1], plane[2], variance, sources, window, scratch)
        if search.geometric_weight > _ZERO:
            one += search.geometric_weight * geometric_error(j, x, y, plane[0], sources, search.max_geometric_px)
        cost += weights[j] * one
        if cost >= stop:
            return max(bound, cost / total)
    return cost / total


@njit(forceinline=True, **COMPILED)
def _propose(kind, x, y, low, high, rate, draw, state, reference, search, scratch):
    """Write the refinement hypothesis number `kind` of scratch.best into scratch.trial; False if there is none."""
    plane, out = scratch.best, scratch.trial
    w, a, b = plane[0], plane[1], plane[2]
    # Cubed: mostly small steps, now and then a large one, so one sweep refines at all scales.
    step = _TWO * uniform(draw) - _ONE
    shift = search.perturbation_px * step * step * step / rate
    height, width = state.cost.shape
    if kind == 0:
        # The slopes that the neighbours' depths imply: keeps normals consistent with the surface.
        if x < 1 or y < 1 or x >= width - 1 or y >= height - 1:
            return False
        a = _HALF * (state.plane[y, x + 1, 0] - state.plane[y, x - 1, 0])
        b = _HALF * (state.plane[y + 1, x, 0] - state.plane[y - 1, x, 0])
    elif kind == 1:
        w = w + shift
        a, b = a * w / plane[0], b * w / plane[0]
    elif kind == 2:
        a, b = turned(x, y, w, a, b, search.normal_perturbation, draw, reference.intrinsics)
    elif kind == 3:
        w = w + shift
        a, b = turned(
            x,
            y,
            w,
            a * w / plane[0],
            b * w / plane[0],
            search.normal_perturbation,
            random_bits(draw),
            reference.intrinsics,
        )
    elif search.random_depth == 1:
        w = low + (high - low) * uniform(draw)
        a, b = turned(x, y, w, a * w / plane[0], b * w / plane[0], _ONE, random_bits(draw), reference.intrinsics)
    else:
        return False
    out[0], out[1], out[2] = w, a, b
    return low <= w <= high and facing(x, y, w, a, b, reference.intrinsics) > _MIN_FACING


@njit(forceinline=True, **COMPILED)
def _compare_candidates(x, y, count, num_chosen, sources, search, scratch):
    """Copy the candidate of the least cost into scratch.best; return its cost."""
    candidates, costs, weights, chosen = scratch.candidates, scratch.costs, scratch.weights, scratch.chosen
    total = _ZERO
    for k in range(num_chosen):
        total += weights[chosen[k]]
    best_cost = np.float32(1e9)
    for i in range(count):
        cost = _ZERO
        for k in range(num_chosen):
            j = chosen[k]
            one = costs[i, j]
            if search.geometric_weight > _ZERO:
                one += search.geometric_weight * geometric_error(
                    j, x, y, candidates[i, 0], sources, search.max_geometric_px
                )
            cost += weights[j] * one
        cost /= total
        if cost < best_cost:
            best_cost = cost
            for c in range(3):
                scratch.best[c] = candidates[i, c]
    return best_cost


@njit(forceinline=True, **COMPILED)
def _update_pixel(x, y, variance, state, reference, sources, window, search, scratch):
    """One step of the search at a textured pixel."""
    candidates, costs, best, trial = scratch.candidates, scratch.costs, scratch.best, scratch.trial
    num_views = sources.warp.shape[0]
    low, high = reference.inverse_range[y, x, 0], reference.inverse_range[y, x, 1]
    count = _gather_candidates(x, y, state, low, high, scratch)
    own = candidates[0, 0]
    rate = _TINY
    for j in range(num_views):
        rate = max(rate, px_per_inverse_depth(j, x, y, own, sources.warp))
    count = _merge_candidates(count, rate, scratch)
    for i in range(count):
        w, a, b = candidates[i, 0], candidates[i, 1], candidates[i, 2]
        for j in range(num_views):
            costs[i, j] = view_cost(j, x, y, w, a, b, variance, sources, window, scratch)
    num_chosen = _select_views(count, state.best_view[y, x], search, scratch)
    cost = _compare_candidates(x, y, count, num_chosen, sources, search, scratch)
    draw = _seed(search.seed, search.iteration, y * state.cost.shape[1] + x)
    for kind in range(5):
        draw = random_bits(draw + np.uint64(0x9E3779B97F4A7C15))
        if not _propose(kind, x, y, low, high, rate, draw, state, reference, search, scratch):
            continue
        trial_cost = _hypothesis_cost(x, y, trial, variance, cost, num_chosen, sources, window, search, scratch)
        if trial_cost < cost:
            cost = trial_cost
            for c in range(3):
                best[c] = trial[c]
    for c in range(3):
        state.plane[y, x, c] = best[c]
    state.cost[y, x] = cost
    state.best_view[y, x] = scratch.chosen[0]


@njit(cache=True, **COMPILED)
def sweep_rows(first_row, last_row, colour, state, reference, sources, window, search, scratch):
    """Update the pixels of one checkerboard colour in a band of rows: propagate, select views, refine.

    Reads pixels of the other colour only, so bands may run at the same time and in any order. Pixels whose window has
    no texture stay as they are.

    Args:
        first_row: of the band.
        last_row: one past the band.
        colour: 0 or 1, the parity of x + y.
        state: (H, W) maps, changed in place.
        reference: the view whose maps these are.
        sources: N source views; with hypothesis maps if `search.geometric_weight` is greater than 0.
        window: the matching window.
        search: what steers the sweep.
        scratch: memory of the band's own, for N views.
    """
    for y in range(first_row, last_row):
        for x in range((y + colour) & 1, reference.inverse_range.shape[1], 2):
            if reference.inverse_range[y, x, 1] <= _ZERO:
                continue
            variance = sample_reference(reference.padded_grey, x, y, window, scratch.weight, scratch.centred)
            if variance >= MIN_VARIANCE:
                _update_pixel(x, y, variance, state, reference, sources, window, search, scratch)


@njit(cache=True, **COMPILED)
def initialise_rows(first_row, last_row, num_random, state, reference, sources, window, search, scratch):
    """Give each pixel of a band of rows the best of its hypothesis so far and random ones, by its better views.

    `state.plane` (H, W, 3) holds hypotheses to begin with, w = 0 where there is none; the state is changed in place.
    Random depths are drawn one from each of `num_random` equal parts of the pixel's interval of inverse depth, normals
    around that of a plane parallel to the image. A hypothesis is judged by the mean of its `search.max_views` least
    costs. Other arguments as in `sweep_rows`.
    """
    width = reference.inverse_range.shape[1]
    num_views = sources.warp.shape[0]
    kept = min(search.max_views, num_views)
    smallest = scratch.weights
    for y in range(first_row, last_row):
        for x in range(width):
            state.best_view[y, x] = -1
            state.cost[y, x] = MAX_COST
            low, high = reference.inverse_range[y, x, 0], reference.inverse_range[y, x, 1]
            if high <= _ZERO:
                state.plane[y, x, 0] = state.plane[y, x, 1] = state.plane[y, x, 2] = _ZERO
                continue
            variance = sample_reference(reference.padded_grey, x, y, window, scratch.weight, scratch.centred)
            draw = _seed(search.seed, -1, y * width + x)
            best_cost = np.float32(1e9)
            prior_w, prior_a, prior_b = state.plane[y, x, 0], state.plane[y, x, 1], state.plane[y, x, 2]
            for i in range(num_random + 1):
                draw = random_bits(draw + np.uint64(0x9E3779B97F4A7C15))
                if i == 0:
                    w, a, b = min(max(prior_w, low), high), prior_a, prior_b
                    if prior_w <= _ZERO:
                        continue
                else:
                    w = low + (high - low) * (np.float32(i - 1) + uniform(draw)) / np.float32(num_random)
                    a, b = turned(x, y, w, _ZERO, _ZERO, np.float32(0.7), random_bits(draw), reference.intrinsics)
                for k in range(kept):
                    smallest[k] = MAX_COST
                if variance >= MIN_VARIANCE:
                    for j in range(num_views):
                        cost = view_cost(j, x, y, w, a, b, variance, sources, window, scratch)
                        for k in range(kept):
                            if cost < smallest[k]:
                                cost, smallest[k] = smallest[k], cost
                cost = _ZERO
                for k in range(kept):
                    cost += smallest[k]
                if cost < best_cost:
                    best_cost = cost
                    state.plane[y, x, 0], state.plane[y, x, 1], state.plane[y, x, 2] = w, a, b
            state.cost[y, x] = best_cost / np.float32(kept)
