"""Compiled loops of the simulated drives: which images observe a point, and records put in their places in a file."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

_MIN_INCIDENCE = 0.2
"""Cosine of the steepest angle at which a feature is still recognised."""


@njit(cache=True)
def is_hidden(a: NDArray[np.float64], b: NDArray[np.float64], houses: NDArray[np.float64]) -> bool:
    """Whether the segment between two positions on the ground passes through a house.

    Args:
        a: (2,) or more, of which x and y count.
        b: The same.
        houses: (H, 4) x and y of the lower corner, x and y of the upper one.
    """
    for house in range(len(houses)):
        enters, leaves = 0.0, 1.0
        for axis in range(2):
            step = b[axis] - a[axis]
            low, high = houses[house, axis] - a[axis], houses[house, axis + 2] - a[axis]
            if abs(step) < 1e-9:
                if low > 0.0 or high < 0.0:
                    leaves = -1.0
                continue
            first, second = low / step, high / step
            enters, leaves = max(enters, min(first, second)), min(leaves, max(first, second))
        if enters < leaves:
            return True
    return False


@njit(cache=True, inline="always")
def _faces(
    point: NDArray[np.float64], normal: NDArray[np.float64], center: NDArray[np.float64], reach_m: float
) -> bool:
    """Whether a point is near enough to a vehicle and faces it."""
    dx, dy, dz = center[0] - point[0], center[1] - point[1], center[2] - point[2]
    distance = math.sqrt(dx * dx + dy * dy + dz * dz)
    return distance <= reach_m and dx * normal[0] + dy * normal[1] + dz * normal[2] >= _MIN_INCIDENCE * distance


@njit(cache=True, inline="always")
def _project(
    image_from_world: NDArray[np.float64], point: NDArray[np.float64], size_px: NDArray[np.float64]
) -> tuple[float, float, bool]:
    """Pixel of a point, and whether it is in the image."""
    m, (x, y, z) = image_from_world, point
    depth = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
    if depth < 1.0:
        return 0.0, 0.0, False
    u = (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) / depth
    v = (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) / depth
    return u, v, 0.0 <= u < size_px[0] and 0.0 <= v < size_px[1]


@njit(cache=True)
def _begin_run(
    chances: NDArray[np.float64], number: int, link_probability: float, mean_length: float
) -> tuple[int, int]:
    """After how many keyframes of a run a track takes part in it, and for how many.

    The numbers of a point's runs follow from its first one's by irrational steps.
    """
    wait = int(3.0 * ((chances[1] + number * 0.4142135624) % 1.0))
    if (chances[0] + number * 0.6180339887) % 1.0 >= link_probability:
        return wait, 0
    chance = (chances[2] + number * 0.7320508076) % 1.0
    return wait, 1 + int(math.log1p(-chance) / math.log1p(-1.0 / mean_length))


@njit(cache=True)
def observe(
    points: NDArray[np.float64],
    normals: NDArray[np.float64],
    reach_m: NDArray[np.float64],
    chances: NDArray[np.float64],
    frames_near: NDArray[np.int64],
    near_ranges: NDArray[np.int64],
    centers: NDArray[np.float64],
    image_from_world: NDArray[np.float64],
    size_px: NDArray[np.float64],
    houses: NDArray[np.float64],
    link_probability: float,
    mean_length: float,
    max_length: int,
) -> tuple[NDArray[np.int32], NDArray[np.float32], NDArray[np.int64]]:
    """Tracks of points as in a video.

    An image can observe a point that is near enough, faces the vehicle, projects into it and isn't hidden by a house.
    From each run of consecutive keyframes in which a camera can, a track takes part of it: with some probability, after
    up to two keyframes, for a geometrically distributed number of keyframes.

    Args:
        points: (P, 3).
        normals: (P, 3) unit vectors out of the surface.
        reach_m: (P,) from how far the feature is recognised.
        chances: (P, 3) uniform random numbers: whether, when and how long.
        frames_near: Keyframes, ascending within each range.
        near_ranges: (P, 2) where in ``frames_near`` the keyframes near a point begin and end.
        centers: (F, 3) of the vehicle.
        image_from_world: (F, C, 3, 4) K [R | t].
        size_px: (2,) width and height of all images.
        houses: (H, 4), see :func:`is_hidden`.
        link_probability: That a run joins the track.
        mean_length: Keyframes that the track has in a run, if none cut it short.
        max_length: Of the whole track.

    Returns:
        (P, max_length) images ``frame * C + camera`` in no particular order, (P, max_length, 2) pixels, (P,) lengths.
    """
    num_cameras = image_from_world.shape[1]
    images = np.empty((len(points), max_length), np.int32)
    pixels = np.empty((len(points), max_length, 2), np.float32)
    lengths = np.zeros(len(points), np.int64)
    last_frame = np.empty(num_cameras, np.int64)
    waits = np.empty(num_cameras, np.int64)
    remains = np.empty(num_cameras, np.int64)
    for p in range(len(points)):
        last_frame[:] = -2
        runs, length = 0, 0
        for frame in frames_near[near_ranges[p, 0] : near_ranges[p, 1]]:
            if not _faces(points[p], normals[p], centers[frame], reach_m[p]):
                continue
            is_in_sight = False
            for camera in range(num_cameras):
                u, v, inside = _project(image_from_world[frame, camera], points[p], size_px)
                if not inside:
                    continue
                if not is_in_sight and is_hidden(centers[frame], points[p], houses):
                    break
                is_in_sight = True
                if last_frame[camera] != frame - 1:
                    waits[camera], remains[camera] = _begin_run(chances[p], runs, link_probability, mean_length)
                    runs += 1
                last_frame[camera] = frame
                if waits[camera] > 0:
                    waits[camera] -= 1
                elif remains[camera] > 0 and length < max_length:
                    remains[camera] -= 1
                    images[p, length] = frame * num_cameras + camera
                    pixels[p, length] = u, v
                    length += 1
        lengths[p] = length
    return images, pixels, lengths


@njit(cache=True)
def scatter_bytes(records: NDArray[np.uint8], starts: NDArray[np.int64], out: NDArray[np.uint8]) -> None:
    """Copy each record (n, width) into ``out`` (bytes,) from its start on."""
    for row in range(len(records)):
        for byte in range(records.shape[1]):
            out[starts[row] + byte] = records[row, byte]
