"""Which images to match: all of a small set; else the ones that the rig, the sequence and the positions suggest."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray

from app.capture.inventory import FrameEntry, Inventory
from app.sfm.options import SfmOptions

Pair = tuple[str, str]
"""Image names, the lesser first."""

EARTH_RADIUS_M = 6_371_000.0
_MIN_DETOUR = 2.0
"""Frames are near again, rather than still, if the path between them is longer than this times their distance."""


def image_pairs(inventory: Inventory, options: SfmOptions, more: Iterable[Pair] = ()) -> list[Pair]:
    """Pairs of images to match, without duplicates, sorted by name.

    Small sets: all pairs. Else per frame the pairs of its own images (the rig), pairs with the images of following
    frames (the sequence), and pairs with images nearby (positions, where there are any; these close loops).

    Args:
        inventory: images and frames.
        options: how far to look.
        more: pairs from another source.
    """
    names = sorted(image.name for image in inventory.images)
    if len(names) <= options.max_exhaustive_images:
        return list(combinations(names, 2))
    known = set(names)
    pairs = {
        (min(pair), max(pair))
        for source in (sequence_pairs(inventory.frames, options), position_pairs(inventory.frames, options), more)
        for pair in source
        if pair[0] != pair[1] and known.issuperset(pair)
    }
    return sorted(pairs)


def sequence_pairs(frames: tuple[FrameEntry, ...], options: SfmOptions) -> Iterator[Pair]:
    """Pairs within each frame, with the frames in the window, and with frames farther on within the same camera.

    Across cameras the window is half as long: what one camera sees now another sees a moment later or not at all.
    """
    window, cross_window = options.sequence_window, (options.sequence_window + 1) // 2
    farther = [window + 2**k for k in range(1, options.sequence_quadratic_window + 1)]
    for index, frame in enumerate(frames):
        yield from combinations(sorted(frame.images.values()), 2)
        for step in (*range(1, window + 1), *farther):
            if index + step >= len(frames):
                break
            other = frames[index + step]
            for (camera, name), (other_camera, other_name) in product(frame.images.items(), other.images.items()):
                if camera == other_camera or step <= cross_window:
                    yield name, other_name


def position_pairs(frames: tuple[FrameEntry, ...], options: SfmOptions) -> Iterator[Pair]:
    """Pairs of images of frames that are near each other but far apart along the path: places visited again.

    Each frame gets the nearest `num_position_neighbors` of such frames within `max_position_distance_m`, all cameras
    with all, because a road driven back shows other cameras the same walls.
    """
    positions = frame_positions_m(frames)
    located = np.flatnonzero(np.isfinite(positions).all(axis=1))
    steps = np.linalg.norm(np.diff(positions[located], axis=0), axis=1)
    path_m = np.concatenate([[0.0], np.cumsum(steps)])
    for row, index in enumerate(located):
        distances = np.linalg.norm(positions[located] - positions[index], axis=1)
        revisits = np.abs(path_m - path_m[row]) > _MIN_DETOUR * distances
        beyond_window = np.abs(located - index) > options.sequence_window
        near = np.flatnonzero(revisits & beyond_window & (distances <= options.max_position_distance_m))
        nearest = near[np.argsort(distances[near], kind="stable")][: options.num_position_neighbors]
        for other in located[nearest]:
            yield from product(frames[index].images.values(), frames[other].images.values())


def frame_positions_m(frames: tuple[FrameEntry, ...]) -> NDArray[np.float64]:
    """(F, 3) metres in a common local frame, NaN where unknown. Positions from pose files come before GPS.

    GPS is laid out on a plane around its first fix and its height left out: phones are tens of metres off there.
    """
    positions = np.full((len(frames), 3), np.nan)
    if any(frame.position_m is not None for frame in frames):
        for row, frame in enumerate(frames):
            if frame.position_m is not None:
                positions[row] = frame.position_m
        return positions
    fixes = [(row, frame.gps) for row, frame in enumerate(frames) if frame.gps is not None]
    if fixes:
        latitude_0, longitude_0, _ = fixes[0][1]
        for row, (latitude, longitude, _) in fixes:
            east = np.radians(longitude - longitude_0) * np.cos(np.radians(latitude_0)) * EARTH_RADIUS_M
            north = np.radians(latitude - latitude_0) * EARTH_RADIUS_M
            positions[row] = (east, north, 0.0)
    return positions
