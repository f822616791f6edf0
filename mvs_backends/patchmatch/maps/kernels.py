"""Compiled operations on whole maps of plane hypotheses."""

# Kernels are typed by what they are called with.
# mypy: disable-error-code="no-untyped-def, untyped-decorator, no-untyped-call, no-any-return"

from __future__ import annotations

import numpy as np
from numba import njit

from mvs_backends.patchmatch.cost.kernels import COMPILED, MAX_COST, PADDING, px_per_inverse_depth

_ZERO = np.float32(0)
_HALF = np.float32(0.5)
_ONE = np.float32(1)


@njit(cache=True, **COMPILED)
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


@njit(cache=True, **COMPILED)
def smooth_rows(first_row, last_row, radius, plane, reference, sources, out):
    """Average each pixel's plane with those of its neighbourhood that agree with it, in a band of rows.

    A neighbour's plane is moved to the pixel; its weight falls off with the shift in the source views between the two,
    to a quarter at a quarter of a pixel. Depth steps stay, the noise of single pixels goes, normals get consistent.
    """
    height, width = plane.shape[:2]
    for y in range(first_row, last_row):
        for x in range(width):
            w = plane[y, x, 0]
            out[y, x, 0], out[y, x, 1], out[y, x, 2] = w, plane[y, x, 1], plane[y, x, 2]
            if w <= _ZERO:
                continue
            rate = _ZERO
            for j in range(sources.warp.shape[0]):
                rate = max(rate, px_per_inverse_depth(j, x, y, w, sources.warp))
            total, sum_w, sum_a, sum_b = _ZERO, _ZERO, _ZERO, _ZERO
            for ny in range(max(y - radius, 0), min(y + radius + 1, height)):
                for nx in range(max(x - radius, 0), min(x + radius + 1, width)):
                    if plane[ny, nx, 0] <= _ZERO:
                        continue
                    a, b = plane[ny, nx, 1], plane[ny, nx, 2]
                    there = plane[ny, nx, 0] + a * np.float32(x - nx) + b * np.float32(y - ny)
                    shift = (there - w) * rate
                    weight = _ONE / (_ONE + np.float32(16) * shift * shift)
                    weight *= weight
                    total += weight
                    sum_w += weight * there
                    sum_a += weight * a
                    sum_b += weight * b
            out[y, x, 0], out[y, x, 1], out[y, x, 2] = sum_w / total, sum_a / total, sum_b / total
