"""Slow plain twins of the kernels of occlusion: every column is asked where a line passes it."""

from __future__ import annotations

import itertools

import numpy as np


def part_in_column(start: np.ndarray, end: np.ndarray, column: tuple[int, int]) -> tuple[float, float] | None:
    """The parameters, 0 at the start and 1 at the end, between which a line is in a unit square; None if nowhere."""
    low, high = 0.0, 1.0
    for axis in (0, 1):
        step = end[axis] - start[axis]
        if step == 0:
            if not column[axis] <= start[axis] < column[axis] + 1:
                return None
            continue
        bounds = sorted(((column[axis] - start[axis]) / step, (column[axis] + 1 - start[axis]) / step))
        low, high = max(low, bounds[0]), min(high, bounds[1])
    return (low, high) if low < high else None


def lower_to_rays(heights: np.ndarray, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Each column's height, or that of the lowest place where a ray passes it."""
    out = heights.copy()
    for column in itertools.product(*map(range, heights.shape)):
        for start, end in zip(starts, ends, strict=True):
            part = part_in_column(start, end, column)
            if part is not None:
                out[column] = min(out[column], *(start[2] + t * (end[2] - start[2]) for t in part))
    return out


def solid_length(tops: np.ndarray, start: np.ndarray, end: np.ndarray) -> float:
    """How far a line runs through columns that are higher than the middle of its part in them, in columns."""
    total = 0.0
    for column in itertools.product(*map(range, tops.shape)):
        part = part_in_column(start, end, column)
        if part is not None and start[2] + sum(part) / 2 * (end[2] - start[2]) < tops[column]:
            total += (part[1] - part[0]) * float(np.hypot(*(end - start)[:2]))
    return total
