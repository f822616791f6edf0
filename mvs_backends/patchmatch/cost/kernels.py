"""Compiled cost of one plane hypothesis at one pixel: bilateral NCC, reprojection error.

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
NUM_CANDIDATES = 9
"""Hypotheses compared at a pixel at once: its own and 8 neighbours'."""
MAX_COST = np.float32(2)
"""Cost 1 - NCC of a perfect anti-correlation; also of a view that doesn't see the patch."""
MIN_VARIANCE = np.float32(2)
"""Patches of less variance (grey values squared) have no texture: noise, or the sky's gradient."""

COMPILED: dict[str, Any] = {"nogil": True, "fastmath": True, "error_model": "numpy", "_nrt": False}
"""How all kernels of this back-end are compiled, those called from Python with `cache=True` on top.

Without numba's reference counting: kernels only borrow arrays, and counting each use of one took two thirds of the time
of a cost. So nothing may be allocated in a kernel.
"""

_ZERO = np.float32(0)
_QUARTER = np.float32(0.25)
_HALF = np.float32(0.5)
_ONE = np.float32(1)
_TWO = np.float32(2)
_TINY = np.float32(1e-12)
_REACH = np.float32(3)
_BYTE = np.uint32(255)
_S8, _S16, _S24 = np.uint32(8), np.uint32(16), np.uint32(24)


class Reference(NamedTuple):
    """The reference view of one sweep, H x W pixels."""

    padded_grey: NDArray[np.uint8]
    """(H + 10, W + 10), the image in a border, so that the window needs no test inside."""
    inverse_range: NDArray[np.float32]
    """(H, W, 2) smallest and largest inverse depth to search; both 0 where nothing is wanted."""
    intrinsics: NDArray[np.float32]
    """(4,) fx, fy, cx, cy."""


class Sources(NamedTuple):
    """The N source views; images and, in geometric passes, hypotheses are one after the other in flat arrays."""

    warp: NDArray[np.float32]
    """(N, 12) A (row by row) and k: reference pixel and inverse depth to homogeneous source pixel."""
    texels: NDArray[np.uint32]
    """(T,) all pixels; each element packs the 2 x 2 neighbourhood to the right and below."""
    first: NDArray[np.uint64]
    """(N,) where each image begins."""
    width: NDArray[np.int32]
    """(N,)"""
    height: NDArray[np.int32]
    """(N,)"""
    limit: NDArray[np.float32]
    """(N, 2) largest x and y at which the neighbourhood is whole."""
    planes: NDArray[np.float32]
    """(T, 3) all pixels' hypotheses; (0, 3) in a photometric pass."""
    warp_back: NDArray[np.float32]
    """(N, 12) source pixel and inverse depth to homogeneous reference pixel."""


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


class Scratch(NamedTuple):
    """Memory that one band of rows works in; N source views, C = NUM_CANDIDATES."""

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
    """(C, 3) hypotheses to compare."""
    multiplicity: NDArray[np.int32]
    """(C,) how many near-identical ones each stands for."""
    costs: NDArray[np.float32]
    """(C, N)"""
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
    floats, rows = np.zeros(NUM_SAMPLES, np.float32), NUM_CANDIDATES
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


@njit(cache=True, **COMPILED)
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


@njit(forceinline=True, **COMPILED)
def sample_reference(grey, x, y, window, weight, centred):
    """Fill the window's normalised bilateral weights and weighted, centred grey values; return the variance.

    Weights fall off with the distance and the difference of grey values to the pixel (x, y), after COLMAP (Schoenberger
    et al. 2016); outside the image they are 0. `grey` is padded by 5 pixels (`Reference.padded_grey`), `weight` and
    `centred` are (32,) and written; the variance is weighted too, in grey values squared.
    """
    px, py = x + PADDING, y + PADDING
    center = np.int32(grey[py, px])
    total, mean, square = _ZERO, _ZERO, _ZERO
    for i in range(NUM_SAMPLES):
        value = np.int32(grey[np.uint64(py + window.row[i]), np.uint64(px + window.column[i])])
        weight[i] = window.space_weight[i] * window.grey_weight[np.uint64(abs(value - center))]
        centred[i] = np.float32(value)
    height, width = grey.shape[0] - 2 * PADDING, grey.shape[1] - 2 * PADDING
    if x < PADDING or y < PADDING or x >= width - PADDING or y >= height - PADDING:
        for i in range(NUM_SAMPLES):
            sx, sy = x + window.column[i], y + window.row[i]
            if sx < 0 or sy < 0 or sx >= width or sy >= height:
                weight[i] = _ZERO
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


@njit(forceinline=True, **COMPILED)
def view_cost(j, pixel_x, pixel_y, w, a, b, variance, sources, window, scratch):
    """1 - bilateral NCC of the plane (w, a, b) at a pixel in source view j, after `sample_reference` there.

    In [0, 2]; 2 too where the patch is not before the view, mostly outside its image, or without texture in it.
    `variance`: as `sample_reference` returned it, at least MIN_VARIANCE.
    """
    x, y = np.float32(pixel_x), np.float32(pixel_y)
    warp, texels, first, width = sources.warp[j], sources.texels, sources.first[j], sources.width[j]
    limit_x, limit_y = sources.limit[j, 0], sources.limit[j, 1]
    bx = warp[0] * x + warp[1] * y + warp[2] + warp[9] * w
    by = warp[3] * x + warp[4] * y + warp[5] + warp[10] * w
    bz = warp[6] * x + warp[7] * y + warp[8] + warp[11] * w
    ux, vx = warp[0] + warp[9] * a, warp[1] + warp[9] * b
    uy, vy = warp[3] + warp[10] * a, warp[4] + warp[10] * b
    uz, vz = warp[6] + warp[11] * a, warp[7] + warp[11] * b
    if bz <= np.float32(7) * (abs(uz) + abs(vz)) + _TINY:
        return MAX_COST
    # Most of the patch must lie in the source image; first order around its centre.
    z = _ONE / bz
    px, py = bx * z, by * z
    reach_x = _REACH * z * (abs(ux - px * uz) + abs(vx - px * vz))
    reach_y = _REACH * z * (abs(uy - py * uz) + abs(vy - py * vz))
    if px < reach_x or py < reach_y or px > limit_x - reach_x or py > limit_y - reach_y:
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
    if spread < _QUARTER * MIN_VARIANCE:
        return MAX_COST
    return min(max(_ONE - s3 / np.sqrt(variance * spread), _ZERO), MAX_COST)


@njit(forceinline=True, **COMPILED)
def geometric_error(j, x, y, w, sources, cap):
    """Forward-backward reprojection error in reference pixels, at most `cap` (ACMM)."""
    t = sources.warp[j]
    fx, fy = np.float32(x), np.float32(y)
    z = t[6] * fx + t[7] * fy + t[8] + t[11] * w
    if z <= _TINY:
        return cap
    z = _ONE / z
    mx = (t[0] * fx + t[1] * fy + t[2] + t[9] * w) * z
    my = (t[3] * fx + t[4] * fy + t[5] + t[10] * w) * z
    width, height = sources.width[j], sources.height[j]
    if mx < -_HALF or my < -_HALF or mx > np.float32(width) - _HALF or my > np.float32(height) - _HALF:
        return cap
    ix, iy = min(np.int32(mx + _HALF), width - 1), min(np.int32(my + _HALF), height - 1)
    index = sources.first[j] + np.uint64(iy * width + ix)
    there = sources.planes[index, 0]
    if there <= _ZERO:
        return cap
    # The source's own plane, not the nearest pixel's depth: on a slanted road the two differ by more than the cap.
    there += sources.planes[index, 1] * (mx - np.float32(ix)) + sources.planes[index, 2] * (my - np.float32(iy))
    r = sources.warp_back[j]
    z = r[6] * mx + r[7] * my + r[8] + r[11] * there
    if z <= _TINY:
        return cap
    z = _ONE / z
    ex = (r[0] * mx + r[1] * my + r[2] + r[9] * there) * z - fx
    ey = (r[3] * mx + r[4] * my + r[5] + r[10] * there) * z - fy
    return min(np.sqrt(ex * ex + ey * ey), cap)


@njit(forceinline=True, **COMPILED)
def px_per_inverse_depth(j, x, y, w, warp):
    """How fast the pixel's projection moves in source view j, in pixels per unit of inverse depth; 0 behind it.

    `warp`: (N, 12) as in `Sources`.
    """
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


@njit(forceinline=True, **COMPILED)
def facing(x, y, w, a, b, intrinsics):
    """Cosine between the plane's normal and the ray of pixel (x, y), positive when the plane faces the camera."""
    nx, ny = a * intrinsics[0], b * intrinsics[1]
    rx, ry = (np.float32(x) - intrinsics[2]) / intrinsics[0], (np.float32(y) - intrinsics[3]) / intrinsics[1]
    nz = w - nx * rx - ny * ry
    return w / np.sqrt((nx * nx + ny * ny + nz * nz) * (rx * rx + ry * ry + _ONE))
