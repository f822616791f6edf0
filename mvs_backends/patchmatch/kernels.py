"""Compiled inner loops of the PatchMatch search: photometric cost, propagation, view selection, refinement.

A hypothesis is a plane, kept per pixel as ``(w, a, b)``: the inverse depth at the pixel and its slopes along x and y.
The inverse depth of a plane is linear in the image, so the hypothesis of a pixel holds at another one as
``w + a dx + b dy``, and the plane-induced warp into a source view is ``A (x, y, 1) + k w(x, y)``: no homography has to
be made, and depth and normal never enter the inner loop.

Pixel centres are at integer coordinates here (COLMAP's minus one half).
"""

# Kernels are typed by what they are called with.
# mypy: disable-error-code="no-untyped-def, untyped-decorator, no-untyped-call, no-any-return"

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

NUM_SAMPLES = 32
"""Samples of the matching window: 6 x 6 without its corners, a whole number of vector registers."""
PADDING = 5
"""Reach of the matching window in pixels."""
MAX_COST = np.float32(2)
"""Cost 1 - NCC of a perfect anti-correlation; also of a view that doesn't see the patch."""

# Without numba's reference counting: kernels only borrow arrays, and counting each use of one took two thirds of the
# time of a cost. So nothing may be allocated in here.
_COMPILED: dict[str, Any] = {"cache": True, "nogil": True, "fastmath": True, "error_model": "numpy", "_nrt": False}

_ZERO = np.float32(0)
_HALF = np.float32(0.5)
_ONE = np.float32(1)
_TWO = np.float32(2)
_TINY = np.float32(1e-12)
_BYTE = np.uint32(255)
_S8, _S16, _S24 = np.uint32(8), np.uint32(16), np.uint32(24)
_MIN_VARIANCE = np.float32(0.6)
_MIN_FACING = np.float32(0.1)
_GOOD_COST = np.float32(0.8)
_GOOD_COST_DECAY = np.float32(90)
_BAD_COST = np.float32(1.2)
_MIN_GOOD = 2
_MAX_BAD = 3
_TWO_BETA_SQUARED = np.float32(2 * 0.3 * 0.3)
_UNIT = np.float32(1.0 / 16777216.0)
NUM_AREAS = 8
_RING_X = np.array(
    [[0, -1, 1, -2, 2, -3, 3], [0, -1, 1, -2, 2, -3, 3], [-1, -2, -2, -3, -3, -4, -4], [1, 2, 2, 3, 3, 4, 4]]
)
_RING_Y = np.array(
    [[-1, -2, -2, -3, -3, -4, -4], [1, 2, 2, 3, 3, 4, 4], [0, -1, 1, -2, 2, -3, 3], [0, -1, 1, -2, 2, -3, 3]]
)
_STRIP_X = np.array([0, 0, -1, 1])
_STRIP_Y = np.array([-1, 1, 0, 0])
_STRIP_FIRST, _STRIP_STEP, _STRIP_LENGTH = 3, 2, 11


class Reference(NamedTuple):
    """The reference view of one sweep, H x W pixels."""

    padded_grey: NDArray[np.uint8]
    """(H + 10, W + 10), the image with its border pixels repeated, so that the window needs no test."""
    inverse_range: NDArray[np.float32]
    """(H, W, 2) smallest and largest inverse depth to search; both 0 where nothing is wanted."""
    intrinsics: NDArray[np.float32]
    """(4,) fx, fy, cx, cy."""
    prior: NDArray[np.float32]
    """(H, W, 3) planar prior, w = 0 where there is none; (0, 0, 3) without a planar prior."""


class Sources(NamedTuple):
    """The N source views, their images and, in geometric passes, their hypotheses, each in one flat array."""

    warp: NDArray[np.float32]
    """(N, 12) A (row by row) and k: reference pixel and inverse depth to homogeneous source pixel."""
    centers: NDArray[np.float32]
    """(N, 3) projection centres in the reference camera's frame."""
    texels: NDArray[np.uint32]
    """(T,) all images; each element packs the 2 x 2 neighbourhood to the right and below."""
    first: NDArray[np.uint64]
    """(N,) where each image begins in `texels`."""
    width: NDArray[np.int32]
    """(N,)"""
    limit: NDArray[np.float32]
    """(N, 2) largest x and y at which the neighbourhood is whole."""
    planes: NDArray[np.float32]
    """(M, 3) all hypothesis maps of the previous pass; (0, 3) in a photometric pass."""
    plane_first: NDArray[np.uint64]
    """(N,)"""
    plane_size: NDArray[np.int32]
    """(N, 2) width, height of each hypothesis map."""
    to_map: NDArray[np.float32]
    """(N, 12) like `warp`, into the source's hypothesis map."""
    from_map: NDArray[np.float32]
    """(N, 12) back: map pixel and inverse depth to homogeneous reference pixel."""


class State(NamedTuple):
    """What a sweep changes."""

    plane: NDArray[np.float32]
    """(H, W, 3) w, a, b."""
    cost: NDArray[np.float32]
    """(H, W) aggregated cost of `plane`, [0, 2] plus the geometric term."""
    best_view: NDArray[np.int8]
    """(H, W) most important source view of the last sweep; -1: none yet."""


class Window(NamedTuple):
    """The matching window."""

    dx: NDArray[np.float32]
    """(32,) offsets in pixels; whole numbers."""
    dy: NDArray[np.float32]
    column: NDArray[np.int64]
    """(32,) dx as whole numbers."""
    row: NDArray[np.int64]
    space_weight: NDArray[np.float32]
    """(32,)"""
    grey_weight: NDArray[np.float32]
    """(256,) weight of a difference of grey values."""


class Search(NamedTuple):
    """Numbers that steer a sweep."""

    seed: int
    iteration: int
    """Counts on over the sweeps of a stage; alters the random numbers and tightens the thresholds."""
    max_views: int
    """Views that the cost of a hypothesis is averaged over, at most."""
    geometric_weight: np.float32
    """lambda of ACMM; 0 in a photometric pass."""
    max_geometric_px: np.float32
    """delta of ACMM."""
    perturbation_px: np.float32
    """Largest shift of a refined hypothesis in the source view."""
    normal_perturbation: np.float32
    """Largest change of a refined normal, as a fraction of its length."""
    min_angle_rad: np.float32
    """Triangulation angle below which a view loses weight."""
    prior_depth_px: np.float32
    """lambda_d of ACMP, as a shift in the source view."""
    random_depth: int
    """1: also try a hypothesis from the whole interval."""


class Scratch(NamedTuple):
    """Memory that one band of rows works in; N source views."""

    fx: NDArray[np.float32]
    """(32,) fractions of the warped sample positions."""
    fy: NDArray[np.float32]
    texel: NDArray[np.int32]
    """(32,) where the samples lie in the source image."""
    value: NDArray[np.uint32]
    """(32,) packed neighbourhoods."""
    weight: NDArray[np.float32]
    """(32,) normalised bilateral weights of the reference patch."""
    centred: NDArray[np.float32]
    """(32,) weighted grey values of the reference patch, their mean taken off."""
    candidates: NDArray[np.float32]
    """(10, 3) hypotheses to compare."""
    multiplicity: NDArray[np.int32]
    """(10,) how many near-identical ones each stands for."""
    costs: NDArray[np.float32]
    """(10, N)"""
    weights: NDArray[np.float32]
    """(N,)"""
    chosen: NDArray[np.int32]
    """(N,)"""
    best: NDArray[np.float32]
    """(3,)"""
    trial: NDArray[np.float32]
    """(3,)"""


def new_scratch(num_views: int) -> Scratch:
    """Memory for one band of rows."""
    floats, rows = np.zeros(NUM_SAMPLES, np.float32), NUM_AREAS + 2
    return Scratch(
        fx=floats.copy(),
        fy=floats.copy(),
        texel=np.zeros(NUM_SAMPLES, np.int32),
        value=np.zeros(NUM_SAMPLES, np.uint32),
        weight=floats.copy(),
        centred=floats.copy(),
        candidates=np.zeros((rows, 3), np.float32),
        multiplicity=np.zeros(rows, np.int32),
        costs=np.zeros((rows, num_views), np.float32),
        weights=np.zeros(num_views, np.float32),
        chosen=np.zeros(num_views, np.int32),
        best=np.zeros(3, np.float32),
        trial=np.zeros(3, np.float32),
    )


@njit(**_COMPILED)
def pack_neighbours(grey: NDArray[np.uint8], out: NDArray[np.uint32]) -> None:
    """Write each pixel and its right, lower and lower right neighbours into one uint32 of the flat (H * W,) out."""
    height, width = grey.shape
    for y in range(height):
        below = min(y + 1, height - 1)
        for x in range(width):
            right = min(x + 1, width - 1)
            out[y * width + x] = (
                np.uint32(grey[y, x])
                | (np.uint32(grey[y, right]) << _S8)
                | (np.uint32(grey[below, x]) << _S16)
                | (np.uint32(grey[below, right]) << _S24)
            )


@njit(forceinline=True, **_COMPILED)
def _random(state: np.uint64) -> np.uint64:
    state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return state ^ (state >> np.uint64(31))


@njit(forceinline=True, **_COMPILED)
def _uniform(state: np.uint64) -> np.float32:
    return np.float32(np.int32(state >> np.uint64(40))) * _UNIT


@njit(forceinline=True, **_COMPILED)
def _seed(seed: int, iteration: int, pixel: int) -> np.uint64:
    return _random(
        np.uint64(seed) * np.uint64(0x9E3779B97F4A7C15)
        + np.uint64(iteration) * np.uint64(0xD1B54A32D192ED03)
        + np.uint64(pixel + 1)
    )


@njit(forceinline=True, **_COMPILED)
def _sample_reference(grey, x, y, window, weight, centred):
    """Fill the window's normalised bilateral weights and weighted, centred grey values; return the variance."""
    px, py = x + PADDING, y + PADDING
    center = np.int32(grey[py, px])
    total, mean, square = _ZERO, _ZERO, _ZERO
    for i in range(NUM_SAMPLES):
        value = np.int32(grey[np.uint64(py + window.row[i]), np.uint64(px + window.column[i])])
        weight[i] = window.space_weight[i] * window.grey_weight[np.uint64(abs(value - center))]
        centred[i] = np.float32(value)
    for i in range(NUM_SAMPLES):
        total += weight[i]
        mean += weight[i] * centred[i]
        square += weight[i] * centred[i] * centred[i]
    scale = _ONE / total
    mean *= scale
    for i in range(NUM_SAMPLES):
        weight[i] *= scale
        centred[i] = weight[i] * (centred[i] - mean)
    return square * scale - mean * mean


@njit(forceinline=True, **_COMPILED)
def _ncc_cost(x, y, w, a, b, variance, warp, texels, first, width, limit_x, limit_y, window, scratch):
    """1 - bilateral NCC of the plane (w, a, b) at pixel (x, y) in one source view."""
    bx = warp[0] * x + warp[1] * y + warp[2] + warp[9] * w
    by = warp[3] * x + warp[4] * y + warp[5] + warp[10] * w
    bz = warp[6] * x + warp[7] * y + warp[8] + warp[11] * w
    ux, vx = warp[0] + warp[9] * a, warp[1] + warp[9] * b
    uy, vy = warp[3] + warp[10] * a, warp[4] + warp[10] * b
    uz, vz = warp[6] + warp[11] * a, warp[7] + warp[11] * b
    if bz <= np.float32(7) * (abs(uz) + abs(vz)) + _TINY:
        return MAX_COST
    if bx < _ZERO or by < _ZERO or bx > limit_x * bz or by > limit_y * bz:
        return MAX_COST
    dx, dy = window.dx, window.dy
    fx, fy, index, value = scratch.fx, scratch.fy, scratch.texel, scratch.value
    weight, centred = scratch.weight, scratch.centred
    for i in range(NUM_SAMPLES):
        z = _ONE / (bz + uz * dx[i] + vz * dy[i])
        px = min(max((bx + ux * dx[i] + vx * dy[i]) * z, _ZERO), limit_x)
        py = min(max((by + uy * dx[i] + vy * dy[i]) * z, _ZERO), limit_y)
        ix, iy = np.int32(px), np.int32(py)
        fx[i] = px - np.float32(ix)
        fy[i] = py - np.float32(iy)
        index[i] = iy * width + ix
    for i in range(NUM_SAMPLES):
        value[i] = texels[first + np.uint64(np.uint32(index[i]))]
    s1, s2, s3 = _ZERO, _ZERO, _ZERO
    for i in range(NUM_SAMPLES):
        v = value[i]
        p00 = np.float32(np.int32(v & _BYTE))
        p01 = np.float32(np.int32((v >> _S8) & _BYTE))
        p10 = np.float32(np.int32((v >> _S16) & _BYTE))
        p11 = np.float32(np.int32(v >> _S24))
        top = p00 + fx[i] * (p01 - p00)
        bottom = p10 + fx[i] * (p11 - p10)
        s = top + fy[i] * (bottom - top)
        ws = weight[i] * s
        s1 += ws
        s2 += ws * s
        s3 += centred[i] * s
    spread = s2 - s1 * s1
    if spread < _HALF * _MIN_VARIANCE:
        return MAX_COST
    return min(max(_ONE - s3 / np.sqrt(variance * spread), _ZERO), MAX_COST)


@njit(forceinline=True, **_COMPILED)
def _view_cost(j, x, y, w, a, b, variance, sources, window, scratch):
    return _ncc_cost(
        np.float32(x),
        np.float32(y),
        w,
        a,
        b,
        variance,
        sources.warp[j],
        sources.texels,
        sources.first[j],
        sources.width[j],
        sources.limit[j, 0],
        sources.limit[j, 1],
        window,
        scratch,
    )


@njit(forceinline=True, **_COMPILED)
def _geometric_error(j, x, y, w, sources, cap):
    """Forward-backward reprojection error in pixels of the reference view, at most `cap` ([X] ACMM eq. 10)."""
    t = sources.to_map[j]
    fx, fy = np.float32(x), np.float32(y)
    z = t[6] * fx + t[7] * fy + t[8] + t[11] * w
    if z <= _TINY:
        return cap
    z = _ONE / z
    mx = (t[0] * fx + t[1] * fy + t[2] + t[9] * w) * z
    my = (t[3] * fx + t[4] * fy + t[5] + t[10] * w) * z
    width, height = sources.plane_size[j, 0], sources.plane_size[j, 1]
    if mx < -_HALF or my < -_HALF or mx > np.float32(width) - _HALF or my > np.float32(height) - _HALF:
        return cap
    ix, iy = min(np.int32(mx + _HALF), width - 1), min(np.int32(my + _HALF), height - 1)
    index = sources.plane_first[j] + np.uint64(iy * width + ix)
    there = sources.planes[index, 0]
    if there <= _ZERO:
        return cap
    # The source's own plane, not the nearest pixel's depth: on a slanted road the two differ by more than the cap.
    there += sources.planes[index, 1] * (mx - np.float32(ix)) + sources.planes[index, 2] * (my - np.float32(iy))
    r = sources.from_map[j]
    z = r[6] * mx + r[7] * my + r[8] + r[11] * there
    if z <= _TINY:
        return cap
    z = _ONE / z
    ex = (r[0] * mx + r[1] * my + r[2] + r[9] * there) * z - fx
    ey = (r[3] * mx + r[4] * my + r[5] + r[10] * there) * z - fy
    return min(np.sqrt(ex * ex + ey * ey), cap)


@njit(forceinline=True, **_COMPILED)
def _facing(x, y, w, a, b, intrinsics):
    """Cosine between the plane's normal and the viewing ray, positive when the plane faces the camera."""
    nx, ny = a * intrinsics[0], b * intrinsics[1]
    rx, ry = (np.float32(x) - intrinsics[2]) / intrinsics[0], (np.float32(y) - intrinsics[3]) / intrinsics[1]
    nz = w - nx * rx - ny * ry
    return w / np.sqrt((nx * nx + ny * ny + nz * nz) * (rx * rx + ry * ry + _ONE))


@njit(forceinline=True, **_COMPILED)
def _turned(x, y, w, a, b, amount, state, intrinsics):
    """Slopes of the plane after a random vector of length up to `amount` is added to its unit normal."""
    fx, fy = intrinsics[0], intrinsics[1]
    rx, ry = (np.float32(x) - intrinsics[2]) / fx, (np.float32(y) - intrinsics[3]) / fy
    nx, ny = a * fx, b * fy
    nz = w - nx * rx - ny * ry
    scale = _ONE / np.sqrt(nx * nx + ny * ny + nz * nz)
    s1 = _random(state)
    s2 = _random(s1)
    s3 = _random(s2)
    nx = nx * scale + amount * (_TWO * _uniform(s1) - _ONE)
    ny = ny * scale + amount * (_TWO * _uniform(s2) - _ONE)
    nz = nz * scale + amount * (_TWO * _uniform(s3) - _ONE)
    along = nx * rx + ny * ry + nz
    ratio = along / np.sqrt((nx * nx + ny * ny + nz * nz) * (rx * rx + ry * ry + _ONE))
    if ratio < _MIN_FACING:
        return a, b
    return w * nx / (fx * along), w * ny / (fy * along)


@njit(forceinline=True, **_COMPILED)
def _px_per_inverse_depth(j, x, y, w, warp):
    """How fast the pixel's projection moves in source view j, in pixels per unit of inverse depth."""
    t = warp[j]
    fx, fy = np.float32(x), np.float32(y)
    z = t[6] * fx + t[7] * fy + t[8] + t[11] * w
    if z <= _TINY:
        return _ZERO
    z = _ONE / z
    px = (t[0] * fx + t[1] * fy + t[2] + t[9] * w) * z
    py = (t[3] * fx + t[4] * fy + t[5] + t[10] * w) * z
    mx, my = (t[9] - px * t[11]) * z, (t[10] - py * t[11]) * z
    return np.sqrt(mx * mx + my * my)


@njit(forceinline=True, **_COMPILED)
def _angle_factor(j, x, y, w, centers, intrinsics, min_angle):
    """(0, 1]: falls off quadratically below the smallest triangulation angle that is worth much."""
    rx = (np.float32(x) - intrinsics[2]) / intrinsics[0]
    ry = (np.float32(y) - intrinsics[3]) / intrinsics[1]
    # Scaled by w, so that a far point needs no large numbers: the point is r, the centre c w.
    cx, cy, cz = centers[j, 0] * w, centers[j, 1] * w, centers[j, 2] * w
    dx, dy, dz = rx - cx, ry - cy, _ONE - cz
    kx, ky, kz = ry * dz - dy, dx - rx * dz, rx * dy - ry * dx
    sine = (kx * kx + ky * ky + kz * kz) / ((rx * rx + ry * ry + _ONE) * (dx * dx + dy * dy + dz * dz))
    return min(sine / (min_angle * min_angle) + np.float32(1e-3), _ONE)


@njit(forceinline=True, **_COMPILED)
def _prior_term(x, y, w, a, b, prior, rate, depth_px, intrinsics):
    """-ln(gamma + exp(...)) of ACMP eq. 9: what the planar prior adds to a hypothesis' score."""
    shift = (w - prior[0]) * rate / depth_px
    fx, fy = intrinsics[0], intrinsics[1]
    rx, ry = (np.float32(x) - intrinsics[2]) / fx, (np.float32(y) - intrinsics[3]) / fy
    ax, ay = a * fx, b * fy
    az = w - ax * rx - ay * ry
    bx, by = prior[1] * fx, prior[2] * fy
    bz = prior[0] - bx * rx - by * ry
    cosine = (ax * bx + ay * by + az * bz) / np.sqrt((ax * ax + ay * ay + az * az) * (bx * bx + by * by + bz * bz))
    angle = np.sqrt(max(_TWO - _TWO * cosine, _ZERO)) / np.float32(0.0873)
    return -np.log(_HALF + np.exp(-_HALF * (shift * shift + angle * angle)))


@njit(forceinline=True, **_COMPILED)
def _gather_candidates(x, y, state, low, high, candidates):
    """Adaptive checkerboard sampling (ACMM section 3.1): the best hypothesis of each of 8 areas, moved here.

    Row 0 of `candidates` (9, 3) is the pixel's own. Returns how many rows are filled.
    """
    height, width = state.cost.shape
    candidates[0, 0], candidates[0, 1], candidates[0, 2] = (
        state.plane[y, x, 0],
        state.plane[y, x, 1],
        state.plane[y, x, 2],
    )
    count = 1
    for area in range(NUM_AREAS):
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


@njit(forceinline=True, **_COMPILED)
def _merge_candidates(candidates, count, rate, multiplicity):
    """Drop candidates that move no sample of the window by a tenth of a pixel against an earlier one; count them."""
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


@njit(forceinline=True, **_COMPILED)
def _select_views(x, y, w, costs, count, multiplicity, previous, reference, sources, search, weights, chosen):
    """Multi-hypothesis joint view selection (ACMM section 3.2): weights of the views, the best first in `chosen`.

    Returns how many views are chosen.
    """
    num_views = sources.warp.shape[0]
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
        if weights[j] > _ZERO and search.min_angle_rad > _ZERO:
            weights[j] *= _angle_factor(j, x, y, w, sources.centers, reference.intrinsics, search.min_angle_rad)
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
    return num_chosen


@njit(forceinline=True, **_COMPILED)
def _fallback_view(costs, count, num_views, weights, chosen):
    """No view is good: take the one with the smallest cost of all."""
    best, best_cost = 0, np.float32(1e9)
    for j in range(num_views):
        for i in range(count):
            if costs[i, j] < best_cost:
                best, best_cost = j, costs[i, j]
    weights[best] = _ONE
    chosen[0] = best
    return 1


@njit(forceinline=True, **_COMPILED)
def _hypothesis_cost(x, y, plane, variance, bound, weights, chosen, num_chosen, sources, window, search, scratch):
    """Weighted cost over the chosen views, or something at least `bound` as soon as it can't be less."""
    total = _ZERO
    for k in range(num_chosen):
        total += weights[chosen[k]]
    stop = bound * total
    cost = _ZERO
    for k in range(num_chosen):
        j = chosen[k]
        one = _view_cost(j, x, y, plane[0], plane[1], plane[2], variance, sources, window, scratch)
        if search.geometric_weight > _ZERO:
            one += search.geometric_weight * _geometric_error(j, x, y, plane[0], sources, search.max_geometric_px)
        cost += weights[j] * one
        if cost >= stop:
            return max(bound, cost / total)
    return cost / total


@njit(forceinline=True, **_COMPILED)
def _score(cost, x, y, plane, reference, search, rate):
    """What is minimised: the cost, or with a planar prior ACMP's negative log posterior."""
    if reference.prior.shape[0] == 0 or reference.prior[y, x, 0] <= _ZERO:
        return cost
    term = _prior_term(
        x, y, plane[0], plane[1], plane[2], reference.prior[y, x], rate, search.prior_depth_px, reference.intrinsics
    )
    return cost * cost / np.float32(2 * 0.18 * 0.18) + term


@njit(forceinline=True, **_COMPILED)
def _propose(kind, x, y, plane, low, high, rate, draw, state, reference, search, out):
    """Write the refinement hypothesis number `kind` into out; False if there is none."""
    w, a, b = plane[0], plane[1], plane[2]
    shift = search.perturbation_px * (_TWO * _uniform(draw) - _ONE) / rate
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
        a, b = _turned(x, y, w, a, b, search.normal_perturbation, draw, reference.intrinsics)
    elif kind == 3:
        w = w + shift
        a, b = _turned(
            x, y, w, a * w / plane[0], b * w / plane[0], search.normal_perturbation, _random(draw), reference.intrinsics
        )
    elif search.random_depth == 1:
        w = low + (high - low) * _uniform(draw)
        a, b = _turned(x, y, w, a * w / plane[0], b * w / plane[0], _ONE, _random(draw), reference.intrinsics)
    else:
        return False
    out[0], out[1], out[2] = w, a, b
    return low <= w <= high and _facing(x, y, w, a, b, reference.intrinsics) > _MIN_FACING


@njit(forceinline=True, **_COMPILED)
def _prior_wins(x, y, state, reference):
    """Without texture only the prior knows."""
    state.cost[y, x] = MAX_COST
    if reference.prior.shape[0] > 0 and reference.prior[y, x, 0] > _ZERO:
        for i in range(3):
            state.plane[y, x, i] = reference.prior[y, x, i]


@njit(**_COMPILED)
def sweep_rows(first_row, last_row, colour, state, reference, sources, window, search, scratch):
    """Update the pixels of one checkerboard colour in a band of rows.

    Reads pixels of the other colour only, so bands may run at the same time and in any order.
    """
    width = reference.inverse_range.shape[1]
    num_views = sources.warp.shape[0]
    candidates, multiplicity, costs = scratch.candidates, scratch.multiplicity, scratch.costs
    weights, chosen, best, trial = scratch.weights, scratch.chosen, scratch.best, scratch.trial
    for y in range(first_row, last_row):
        for x in range((y + colour) & 1, width, 2):
            low, high = reference.inverse_range[y, x, 0], reference.inverse_range[y, x, 1]
            if high <= _ZERO:
                continue
            variance = _sample_reference(reference.padded_grey, x, y, window, scratch.weight, scratch.centred)
            if variance < _MIN_VARIANCE:
                _prior_wins(x, y, state, reference)
                continue
            count = _gather_candidates(x, y, state, low, high, candidates)
            own = candidates[0, 0]
            rate = _ZERO
            for j in range(num_views):
                rate = max(rate, _px_per_inverse_depth(j, x, y, own, sources.warp))
            if rate <= _ZERO:
                continue
            count = _merge_candidates(candidates, count, rate, multiplicity)
            if reference.prior.shape[0] > 0 and reference.prior[y, x, 0] > _ZERO:
                for i in range(3):
                    candidates[count, i] = reference.prior[y, x, i]
                multiplicity[count] = 1
                count += 1
            for i in range(count):
                for j in range(num_views):
                    costs[i, j] = _view_cost(
                        j,
                        x,
                        y,
                        candidates[i, 0],
                        candidates[i, 1],
                        candidates[i, 2],
                        variance,
                        sources,
                        window,
                        scratch,
                    )
            num_chosen = _select_views(
                x,
                y,
                own,
                costs,
                count,
                multiplicity,
                state.best_view[y, x],
                reference,
                sources,
                search,
                weights,
                chosen,
            )
            if num_chosen == 0:
                num_chosen = _fallback_view(costs, count, num_views, weights, chosen)
            total = _ZERO
            for k in range(num_chosen):
                total += weights[chosen[k]]
            best_score, best_cost = np.float32(1e9), MAX_COST
            for i in range(count):
                cost = _ZERO
                for k in range(num_chosen):
                    j = chosen[k]
                    one = costs[i, j]
                    if search.geometric_weight > _ZERO:
                        one += search.geometric_weight * _geometric_error(
                            j, x, y, candidates[i, 0], sources, search.max_geometric_px
                        )
                    cost += weights[j] * one
                cost /= total
                score = _score(cost, x, y, candidates[i], reference, search, rate)
                if score < best_score:
                    best_score, best_cost = score, cost
                    best[0], best[1], best[2] = candidates[i, 0], candidates[i, 1], candidates[i, 2]
            draw = _seed(search.seed, search.iteration, y * width + x)
            for kind in range(5):
                draw = _random(draw + np.uint64(0x9E3779B97F4A7C15))
                if not _propose(kind, x, y, best, low, high, rate, draw, state, reference, search, trial):
                    continue
                bound = best_cost if reference.prior.shape[0] == 0 else np.float32(1e9)
                cost = _hypothesis_cost(
                    x, y, trial, variance, bound, weights, chosen, num_chosen, sources, window, search, scratch
                )
                score = _score(cost, x, y, trial, reference, search, rate)
                if score < best_score:
                    best_score, best_cost = score, cost
                    best[0], best[1], best[2] = trial[0], trial[1], trial[2]
            state.plane[y, x, 0], state.plane[y, x, 1], state.plane[y, x, 2] = best[0], best[1], best[2]
            state.cost[y, x] = best_cost
            state.best_view[y, x] = chosen[0]


@njit(**_COMPILED)
def initialise_rows(first_row, last_row, num_random, state, reference, sources, window, search, scratch):
    """Give each pixel of a band of rows the best of its hypothesis so far and random ones, by its better views."""
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
            variance = _sample_reference(reference.padded_grey, x, y, window, scratch.weight, scratch.centred)
            draw = _seed(search.seed, -1, y * width + x)
            best_cost = np.float32(1e9)
            prior_w, prior_a, prior_b = state.plane[y, x, 0], state.plane[y, x, 1], state.plane[y, x, 2]
            for i in range(num_random + 1):
                draw = _random(draw + np.uint64(0x9E3779B97F4A7C15))
                if i == 0:
                    w, a, b = min(max(prior_w, low), high), prior_a, prior_b
                    if prior_w <= _ZERO:
                        continue
                else:
                    w = low + (high - low) * (np.float32(i - 1) + _uniform(draw)) / np.float32(num_random)
                    a, b = _turned(x, y, w, _ZERO, _ZERO, np.float32(0.7), _random(draw), reference.intrinsics)
                for k in range(kept):
                    smallest[k] = MAX_COST
                if variance >= _MIN_VARIANCE:
                    for j in range(num_views):
                        cost = _view_cost(j, x, y, w, a, b, variance, sources, window, scratch)
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


@njit(**_COMPILED)
def upsample(coarse, coarse_cost, coarse_view, coarse_grey, scale_x, scale_y, state, reference):
    """Carry a coarser level's hypotheses to a finer one: of the 4 nearest, the one of the most similar grey value.

    `scale_x`, `scale_y`: coarse pixels per fine pixel.
    """
    height, width = reference.inverse_range.shape[:2]
    coarse_height, coarse_width = coarse_cost.shape
    for y in range(height):
        cy = (np.float32(y) + _HALF) * scale_y - _HALF
        y0 = np.int64(np.floor(cy))
        for x in range(width):
            state.cost[y, x] = MAX_COST
            state.best_view[y, x] = -1
            state.plane[y, x, 0] = state.plane[y, x, 1] = state.plane[y, x, 2] = _ZERO
            low, high = reference.inverse_range[y, x, 0], reference.inverse_range[y, x, 1]
            if high <= _ZERO:
                continue
            cx = (np.float32(x) + _HALF) * scale_x - _HALF
            x0 = np.int64(np.floor(cx))
            best = np.float32(1e9)
            for dy in range(2):
                for dx in range(2):
                    nx, ny = min(max(x0 + dx, 0), coarse_width - 1), min(max(y0 + dy, 0), coarse_height - 1)
                    if coarse[ny, nx, 0] <= _ZERO:
                        continue
                    ox, oy = cx - np.float32(nx), cy - np.float32(ny)
                    difference = np.float32(
                        abs(np.int32(coarse_grey[ny, nx]) - np.int32(reference.padded_grey[y + PADDING, x + PADDING]))
                    )
                    badness = difference / np.float32(10) + np.float32(0.5) * (ox * ox + oy * oy) + coarse_cost[ny, nx]
                    if badness < best:
                        best = badness
                        w = coarse[ny, nx, 0] + coarse[ny, nx, 1] * ox + coarse[ny, nx, 2] * oy
                        state.plane[y, x, 0] = min(max(w, low), high)
                        state.plane[y, x, 1] = coarse[ny, nx, 1] * scale_x
                        state.plane[y, x, 2] = coarse[ny, nx, 2] * scale_y
                        state.cost[y, x] = coarse_cost[ny, nx]
                        state.best_view[y, x] = coarse_view[ny, nx]
            if best > np.float32(1e8):
                state.plane[y, x, 0] = _HALF * (low + high)
