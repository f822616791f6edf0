"""Compiled search for the planes that most points of a region lie on.

A point is a row (column, row, inverse depth, rate): the rate is how many pixels a unit of inverse depth moves it in a
source view, so that errors are in pixels. A fitted plane is a row of `FIT_SIZE` numbers: the column and row of the
points' centroid, the inverse depth there, its slopes along columns and rows, and the variance of the plane's error in
pixels, as the constant and the coefficients of dx dx, dx dy and dy dy about the centroid.
"""
# Kernels are typed by what they are called with.
# mypy: disable-error-code="no-untyped-def, untyped-decorator, no-untyped-call, no-any-return"

from __future__ import annotations

import numpy as np
from numba import njit

from mvs_backends.patchmatch.cost.kernels import COMPILED
from mvs_backends.patchmatch.kernels import random_bits

MAX_PLANES = 3
"""Of a region."""
FIT_SIZE = 9
"""Numbers of a fitted plane."""
MIN_POINTS = 30
"""Fewer determine no plane."""
MAX_ERROR_PX = 3.0
"""Of a point that lies on a plane, and of a plane at a pixel where it is known."""

_NUM_TRIALS, _NUM_REFINEMENTS = 60, 3
# Of more, evenly spread ones tell how good a trial is.
_MAX_SCORED_POINTS = 2000
# Of a region's points.
_MIN_SHARE_FIRST, _MIN_SHARE_OTHER = 0.4, 0.15
# Twice the area in pixels of the triangle of a trial.
_MIN_DETERMINANT = 10.0
# The points' extents along their two axes, squared, to each other: less is a line.
_MIN_WIDTH = 1e-9
# So many points' errors are alike, as the windows of pixels overlap.
_CORRELATED_POINTS = 25


@njit(forceinline=True, **COMPILED)
def _is_on(points, i, fit):
    """Whether a point lies on a plane."""
    there = fit[2] + fit[3] * (points[i, 0] - fit[0]) + fit[4] * (points[i, 1] - fit[1])
    return abs(there - points[i, 2]) * points[i, 3] < MAX_ERROR_PX


@njit(forceinline=True, **COMPILED)
def _draw(points, left, num_left, state, fit):
    """Lay a plane through three random ones of the points left; False if they lie in a line."""
    first = np.int64(random_bits(state + np.uint64(1)) % np.uint64(num_left))
    second = np.int64(random_bits(state + np.uint64(2)) % np.uint64(num_left))
    third = np.int64(random_bits(state + np.uint64(3)) % np.uint64(num_left))
    i, j, k = left[first], left[second], left[third]
    x1, y1, w1 = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]
    x2, y2, w2 = points[k, 0] - points[i, 0], points[k, 1] - points[i, 1], points[k, 2] - points[i, 2]
    determinant = x1 * y2 - x2 * y1
    if abs(determinant) <= _MIN_DETERMINANT:
        return False
    fit[0], fit[1], fit[2] = points[i, 0], points[i, 1], points[i, 2]
    fit[3] = (w1 * y2 - w2 * y1) / determinant
    fit[4] = (x1 * w2 - x2 * w1) / determinant
    return True


@njit(**COMPILED)
def _least_squares(points, inliers, num_inliers, fit):
    """Fit a plane to some points; False if they lie in a line."""
    x = y = w = 0.0
    for n in range(num_inliers):
        i = inliers[n]
        x += points[i, 0]
        y += points[i, 1]
        w += points[i, 2]
    x, y, w = x / num_inliers, y / num_inliers, w / num_inliers
    xx = xy = yy = xw = yw = 0.0
    for n in range(num_inliers):
        i = inliers[n]
        dx, dy, dw = points[i, 0] - x, points[i, 1] - y, points[i, 2] - w
        xx += dx * dx
        xy += dx * dy
        yy += dy * dy
        xw += dx * dw
        yw += dy * dw
    determinant = xx * yy - xy * xy
    if determinant <= _MIN_WIDTH * (xx + yy) * (xx + yy):
        return False
    a, b = (xw * yy - yw * xy) / determinant, (yw * xx - xw * xy) / determinant
    squares = 0.0
    for n in range(num_inliers):
        i = inliers[n]
        error = (w + a * (points[i, 0] - x) + b * (points[i, 1] - y) - points[i, 2]) * points[i, 3]
        squares += error * error
    variance = _CORRELATED_POINTS * squares / num_inliers
    fit[0], fit[1], fit[2], fit[3], fit[4] = x, y, w, a, b
    fit[5], fit[6] = variance / num_inliers, variance * yy / determinant
    fit[7], fit[8] = -2 * variance * xy / determinant, variance * xx / determinant
    return True


@njit(**COMPILED)
def _largest_plane(points, left, num_left, seed, inliers, fit):
    """Find the plane that most of the points left lie on, by random sampling; how many do."""
    first = np.uint64(seed) * np.uint64(0x9E3779B97F4A7C15)
    step = 1 + (num_left - 1) // _MAX_SCORED_POINTS
    best, most = first, -1
    for number in range(_NUM_TRIALS):
        state = first + np.uint64(3 * number)
        if not _draw(points, left, num_left, state, fit):
            continue
        count = 0
        for n in range(0, num_left, step):
            count += _is_on(points, left[n], fit)
        if count > most:
            best, most = state, count
    if not _draw(points, left, num_left, best, fit):
        return 0
    for _ in range(_NUM_REFINEMENTS):
        num_inliers = 0
        for n in range(num_left):
            if _is_on(points, left[n], fit):
                inliers[num_inliers] = left[n]
                num_inliers += 1
        if num_inliers < MIN_POINTS or not _least_squares(points, inliers, num_inliers, fit):
            return 0
    return num_inliers


@njit(cache=True, **COMPILED)
def find_planes(points, seed, left, inliers, fits, owner):
    """Find the planes of a region, the one with most points first, each among the points that lie on none before.

    Args:
        points: (P, 4)
        seed: of the random numbers.
        left: (P,) memory to work in.
        inliers: (P,) the same.
        fits: (MAX_PLANES, FIT_SIZE) the planes.
        owner: (P,) number of each point's plane, -1 for those that lie on none.

    Returns:
        How many planes there are.
    """
    num_left = len(points)
    for i in range(num_left):
        left[i], owner[i] = i, -1
    for number in range(MAX_PLANES):
        if num_left < MIN_POINTS:
            return number
        fit = fits[number]
        num_inliers = _largest_plane(points, left, num_left, MAX_PLANES * seed + number, inliers, fit)
        share = _MIN_SHARE_OTHER if number > 0 else _MIN_SHARE_FIRST
        if num_inliers < max(MIN_POINTS, share * len(points)):
            return number
        for n in range(num_inliers):
            owner[inliers[n]] = number
        rest = 0
        for n in range(num_left):
            if owner[left[n]] < 0:
                left[rest] = left[n]
                rest += 1
        num_left = rest
    return MAX_PLANES


@njit(cache=True, **COMPILED)
def paint_planes(regions, region, nearest, fits, planes):
    """Write the planes of a region at its pixels, where they are known.

    Args:
        regions: (H, W) numbers of regions.
        region: number of the one.
        nearest: (H, W) number of the plane that each pixel takes.
        fits: (MAX_PLANES, FIT_SIZE) the planes.
        planes: (H, W, 3) inverse depth and its slopes along x and y.
    """
    for y in range(regions.shape[0]):
        for x in range(regions.shape[1]):
            if regions[y, x] != region:
                continue
            fit = fits[nearest[y, x]]
            dx, dy = x - fit[0], y - fit[1]
            if fit[5] + fit[6] * dx * dx + fit[7] * dx * dy + fit[8] * dy * dy < MAX_ERROR_PX * MAX_ERROR_PX:
                planes[y, x, 0] = fit[2] + fit[3] * dx + fit[4] * dy
                planes[y, x, 1], planes[y, x, 2] = fit[3], fit[4]
