"""Slow plain twins of the kernels of the simulated drives."""

from __future__ import annotations

import math

import numpy as np


def is_hidden(a: np.ndarray, b: np.ndarray, houses: np.ndarray) -> bool:
    """Look at many places of the segment whether they lie in a house; misses cuts of less than a thousandth."""
    places = a[:2] + np.linspace(0.0, 1.0, 2001)[:, None] * (b[:2] - a[:2])
    return any(bool(np.any(np.all((places > house[:2]) & (places < house[2:]), axis=1))) for house in houses)


def observe(
    point: np.ndarray,
    normal: np.ndarray,
    reach_m: float,
    chances: np.ndarray,
    centers: np.ndarray,
    image_from_world: np.ndarray,
    size_px: np.ndarray,
    houses: np.ndarray,
    link_probability: float,
    mean_length: float,
) -> set[int]:
    """Images ``frame * C + camera`` in one point's track: what each can see, then what a track takes of it."""
    num_frames, num_cameras = image_from_world.shape[:2]
    towards = centers - point
    distances = np.linalg.norm(towards, axis=1)
    runs: list[list[int]] = []
    run_of: dict[tuple[int, int], list[int]] = {}
    for frame in range(num_frames):
        if distances[frame] > reach_m or towards[frame] @ normal < 0.2 * distances[frame]:
            continue
        if is_hidden(centers[frame], point, houses):
            continue
        for camera in range(num_cameras):
            x, y, z = image_from_world[frame, camera] @ np.append(point, 1.0)
            if z < 1 or not (0 <= x / z < size_px[0] and 0 <= y / z < size_px[1]):
                continue
            run = run_of.pop((frame - 1, camera), [])
            if not run:
                runs.append(run)
            run.append(frame * num_cameras + camera)
            run_of[frame, camera] = run
    track: set[int] = set()
    for number, run in enumerate(runs):
        joins, wait, length = (chances + number * np.array([0.6180339887, 0.4142135624, 0.7320508076])) % 1.0
        if joins < link_probability:
            first = int(3 * wait)
            track.update(run[first : first + 1 + int(math.log1p(-length) / math.log1p(-1 / mean_length))])
    return track
