"""Compiled operations on whole maps of plane hypotheses."""

# Kernels are typed by what they are called with.
# mypy: disable-error-code="no-untyped-def, untyped-decorator, no-untyped-call, no-any-return"

from __future__ import annotations

import numpy as np
from numba import njit

from mvs_backends.patchmatch.cost.kernels import (
    COMPILED,
    MAX_COST,
    MIN_VARIANCE,
    PADDING,
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
_DISTINCT_STEP_PX, _DISTINCT_COST = np.float32(2), np.float32(0.1)
_MIN_CONFIRMING = 2
# Of a plane that the ray nearly lies in.
_MIN_REST = np.float32(0.05)
_AGREEING, _AGREEING_PX, _AGREEING_AT_MOST = np.float32(0.01), np.float32(0.5), np.float32(0.03)


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


@njit(cache=True, **COMPILED)
def credible_rows(first_row, last_row, wanted, plane, max_cost, reference, sources, window, scratch, credible):
    """Find the wanted pixels that two source views confirm, in a band of rows.

    A view confirms a hypothesis that costs at most `max_cost` there, and 0.1 more if moved by 2 pixels either way (on a
    smooth shade or along an edge it costs little everywhere), if the view's own map reprojects to within a pixel of it.
    """
    for y in range(first_row, last_row):
        for x in range(plane.shape[1]):
            w, a, b = plane[y, x, 0], plane[y, x, 1], plane[y, x, 2]
            credible[y, x] = False
            if w <= _ZERO or not wanted[y, x]:
                continue
            variance = sample_reference(reference.padded_grey, x, y, window, scratch.weight, scratch.centred)
            if variance < MIN_VARIANCE:
                continue
            confirming = 0
            for j in range(sources.warp.shape[0]):
                if geometric_error(j, x, y, w, sources, _TWO) > _ONE:
                    continue
                cost = view_cost(j, x, y, w, a, b, variance, sources, window, scratch)
                if cost > max_cost:
                    continue
                step = _DISTINCT_STEP_PX / max(px_per_inverse_depth(j, x, y, w, sources.warp), _TINY)
                nearer = view_cost(j, x, y, w + step, a, b, variance, sources, window, scratch)
                farther = view_cost(j, x, y, w - step, a, b, variance, sources, window, scratch)
                if min(nearer, farther) > cost + _DISTINCT_COST:
                    confirming += 1
            credible[y, x] = confirming >= _MIN_CONFIRMING


@njit(cache=True, **COMPILED)
def parallax_rates(points, sources, rates):
    """Pixels per inverse depth of points (column, row, inverse depth) in the source view where they are most."""
    for i in range(len(points)):
        rates[i] = _ZERO
        for j in range(sources.warp.shape[0]):
            rate = px_per_inverse_depth(j, points[i, 0], points[i, 1], points[i, 2], sources.warp)
            rates[i] = max(rates[i], rate)


@njit(cache=True, **COMPILED)
def add_agreeing_rows(first_row, last_row, plane, source, warp, sums):
    """Add the inverse depths that a source view's planes give the pixels of a band of rows, where the two views agree.

    A pixel's ray meets the plane of the source pixel that it projects to. If that is within 1 % of the pixel's own
    inverse depth, or half a pixel in the source view but no more than 3 %, it is added, with a weight that falls to 0
    at that bound, and with the square of the distance from the source view.

    Args:
        first_row: of the band.
        last_row: after the band; may lie beyond the image.
        plane: (H, W, 3) the view's own planes.
        source: (H', W', 3) those of the source view.
        warp: (12,) as in `Sources`.
        sums: (H, W, 2) weights, and weights times inverse depths.
    """
    height, width = source.shape[:2]
    for y in range(first_row, min(last_row, plane.shape[0])):
        for x in range(plane.shape[1]):
            w = plane[y, x, 0]
            if w <= _ZERO:
                continue
            fx, fy = np.float32(x), np.float32(y)
            p0 = warp[0] * fx + warp[1] * fy + warp[2]
            p1 = warp[3] * fx + warp[4] * fy + warp[5]
            p2 = warp[6] * fx + warp[7] * fy + warp[8]
            q2 = p2 + warp[11] * w
            if q2 <= _TINY:
                continue
            u, v = (p0 + warp[9] * w) / q2, (p1 + warp[10] * w) / q2
            if not (-_HALF <= u < np.float32(width) - _HALF and -_HALF <= v < np.float32(height) - _HALF):
                continue
            column, row = np.int64(np.floor(u + _HALF)), np.int64(np.floor(v + _HALF))
            there, a, b = source[row, column, 0], source[row, column, 1], source[row, column, 2]
            if there <= _ZERO:
                continue
            # The source's plane is c . q = w for homogeneous source pixels q = p + k w.
            c2 = there - a * np.float32(column) - b * np.float32(row)
            rest = _ONE - (a * warp[9] + b * warp[10] + c2 * warp[11])
            if abs(rest) < _MIN_REST:
                continue
            error = abs((a * p0 + b * p1 + c2 * p2) / rest - w)
            moved = np.hypot(warp[9] - u * warp[11], warp[10] - v * warp[11]) / q2
            bound = max(_AGREEING * w, min(_AGREEING_PX / max(moved, _TINY), _AGREEING_AT_MOST * w))
            if error < bound:
                closeness = _ONE - (error / bound) * (error / bound)
                weight = closeness * closeness / (q2 * q2)
                sums[y, x, 0] += weight
                sums[y, x, 1] += weight * (a * p0 + b * p1 + c2 * p2) / rest
