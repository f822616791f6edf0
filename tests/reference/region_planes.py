"""Slow plain twins of the kernels that find the planes of a region, with the same random numbers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tests.reference.patchmatch import MASK, Array, random_bits


def drawn(num_left: int, seed: int, number: int) -> list[int]:
    """Places of the three points of a trial among those left."""
    state = seed * 0x9E3779B97F4A7C15 + 3 * number
    return [random_bits((state + corner) & MASK) % num_left for corner in (1, 2, 3)]


def least_squares(points: Array) -> Array:
    """(3,) inverse depth at the origin and its slopes."""
    return np.linalg.lstsq(design(points), points[:, 2], rcond=None)[0]


def design(points: Array) -> Array:
    """(P, 3) 1, column, row."""
    return np.column_stack([np.ones(len(points)), points[:, :2]])


def errors_px(points: Array, plane: Array) -> Array:
    """(P,) how far points are from a plane, in pixels of a source view."""
    return (design(points) @ plane - points[:, 2]) * points[:, 3]


def largest_plane(points: Array, seed: int) -> NDArray[np.int64]:
    """Indices of the points on the plane that most lie on, after 60 trials and 3 refinements."""
    trials = []
    for number in range(60):
        corners = points[drawn(len(points), seed, number)]
        if abs(np.linalg.det(design(corners))) > 10:
            trials.append(np.linalg.solve(design(corners), corners[:, 2]))
    scored = points[:: 1 + (len(points) - 1) // 2000]
    if not trials:
        return np.empty(0, np.int64)
    plane = max(trials, key=lambda trial: np.count_nonzero(np.abs(errors_px(scored, trial)) < 3))
    for _ in range(3):
        inliers = np.flatnonzero(np.abs(errors_px(points, plane)) < 3)
        if len(inliers) < 30 or np.linalg.matrix_rank(design(points[inliers])) < 3:
            return np.empty(0, np.int64)
        plane = least_squares(points[inliers])
    return inliers


def owners(points: Array, seed: int) -> NDArray[np.int64]:
    """(P,) number of the plane that each point lies on, -1 for none; at most three planes."""
    owner = np.full(len(points), -1)
    for number, share in enumerate((0.4, 0.15, 0.15)):
        left = np.flatnonzero(owner < 0)
        if len(left) < 30:
            break
        inliers = left[largest_plane(points[left], 3 * seed + number)]
        if len(inliers) < max(30, share * len(points)):
            break
        owner[inliers] = number
    return owner


def painted(points: Array, owner: NDArray[np.int64], nearest: NDArray[np.int64]) -> Array:
    """(H, W, 3) planes where their standard error is below 3 pixels, 25 points counting as one; else 0."""
    result = np.zeros((*nearest.shape, 3))
    for number in range(owner.max() + 1):
        own = points[owner == number]
        plane = least_squares(own)
        covariance = np.linalg.inv(design(own).T @ design(own)) * np.mean(errors_px(own, plane) ** 2) * 25
        for y, x in np.argwhere(nearest == number):
            here = np.array([1, x, y])
            if here @ covariance @ here < 3**2:
                result[y, x] = here @ plane, plane[1], plane[2]
    return result
