"""Keypoints of a drive and their tracks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.drives.district import District
from benchmarks.drives.kernels import observe
from benchmarks.drives.surfaces import Surfaces
from benchmarks.drives.vehicle import CAMERAS, IMAGE_SIZE_PX, Keyframes

_OUTLIER_SHARE = 0.01
_MEDIAN_OUTLIER_DISTANCE_M = 120.0
_MEDIAN_REACH_M = 25.0
_MAX_REACH_M = 50.0
_LINK_PROBABILITY = 0.45
_MEAN_RUN_KEYFRAMES = 4.0
_MAX_TRACK_LENGTH = 48
_PIXEL_NOISE_PX = 0.5
_LOOKUP_CELL_M = 20.0
_BATCH = 50_000
_HOUSE_MARGIN_M = 0.3
"""Houses hide what lies behind this much of their walls; what is on the wall is seen."""


@dataclass(frozen=True, kw_only=True)
class Keypoints:
    """P points and their T observations."""

    points: NDArray[np.float64]
    """(P, 3) in the district's frame, in the order of their first images."""
    track_lengths: NDArray[np.int64]
    """(P,) at least 2."""
    track_images: NDArray[np.int64]
    """(T,) ``frame * 7 + camera``, point by point, ascending and unique within each."""
    track_pixels: NDArray[np.float64]
    """(T, 2) with half a pixel of noise."""


def make_keypoints(
    district: District, surfaces: Surfaces, keyframes: Keyframes, num_points: int, rng: np.random.Generator
) -> Keypoints:
    """Draw points until ``num_points`` of them have tracks of at least two images."""
    houses = district.houses() + _HOUSE_MARGIN_M * np.array([1.0, 1.0, -1.0, -1.0])
    frames_near, near_ranges, first_cell, shape = _frames_by_cell(keyframes.centers_m)
    parts = [_outliers(keyframes, round(_OUTLIER_SHARE * num_points), rng)]
    missing = num_points - len(parts[0].points)
    while missing > 0:
        points, normals = surfaces.draw(_BATCH, rng)
        cells = np.clip(np.floor(points[:, :2] / _LOOKUP_CELL_M).astype(np.int64) - first_cell, 0, shape - 1)
        images, pixels, lengths = observe(
            points,
            normals,
            np.minimum(_MEDIAN_REACH_M * rng.lognormal(0.0, 0.4, _BATCH), _MAX_REACH_M),
            rng.random((_BATCH, 3)),
            frames_near,
            near_ranges[cells[:, 0] * shape[1] + cells[:, 1]],
            keyframes.centers_m,
            keyframes.image_from_district,
            np.array(IMAGE_SIZE_PX, dtype=np.float64),
            houses,
            _LINK_PROBABILITY,
            _MEAN_RUN_KEYFRAMES,
            _MAX_TRACK_LENGTH,
        )
        kept = np.flatnonzero(lengths >= 2)[:missing]
        filled = np.arange(_MAX_TRACK_LENGTH) < lengths[kept, None]
        parts.append(
            Keypoints(
                points=points[kept],
                track_lengths=lengths[kept],
                track_images=images[kept][filled].astype(np.int64),
                track_pixels=pixels[kept][filled].astype(np.float64),
            )
        )
        missing -= len(kept)
    return _ordered(parts, rng)


def _frames_by_cell(
    centers: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Keyframes that may see a point in each cell of a grid: rows, ranges of rows per cell, first cell, shape."""
    low = np.floor((centers[:, :2].min(axis=0) - _MAX_REACH_M) / _LOOKUP_CELL_M).astype(np.int64)
    high = np.floor((centers[:, :2].max(axis=0) + _MAX_REACH_M) / _LOOKUP_CELL_M).astype(np.int64)
    shape = high - low + 1
    reach = _MAX_REACH_M + _LOOKUP_CELL_M / np.sqrt(2)
    near = []
    for i, j in np.ndindex(*shape):
        middle = (low + (i, j) + 0.5) * _LOOKUP_CELL_M
        near.append(np.flatnonzero(np.hypot(*(centers[:, :2] - middle).T) < reach))
    ends = np.cumsum([len(rows) for rows in near])
    return np.concatenate(near), np.stack([np.append(0, ends[:-1]), ends], axis=1), low, shape


def _outliers(keyframes: Keyframes, count: int, rng: np.random.Generator) -> Keypoints:
    """Wrong matches between an image and the same camera's next one, mostly far away."""
    num_frames, num_cameras = len(keyframes.centers_m), len(CAMERAS)
    frames, cameras = rng.integers(0, num_frames - 1, 4 * count), rng.integers(0, num_cameras, 4 * count)
    pixels = rng.uniform((0.0, 0.0), IMAGE_SIZE_PX, (4 * count, 2))
    depths = _MEDIAN_OUTLIER_DISTANCE_M * rng.lognormal(0.0, 1.0, 4 * count)
    matrices = keyframes.image_from_district
    here, there = matrices[frames, cameras], matrices[frames + 1, cameras]
    rays = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1) * depths[:, None]
    points = np.linalg.solve(here[:, :, :3], (rays - here[:, :, 3])[..., None])[..., 0]
    seen = np.einsum("nij,nj->ni", there[:, :, :3], points) + there[:, :, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        seen_pixels = seen[:, :2] / seen[:, 2:]
    kept = np.flatnonzero(
        (seen[:, 2] > 1.0) & (seen_pixels >= 0).all(axis=1) & (seen_pixels < IMAGE_SIZE_PX).all(axis=1)
    )[:count]
    images = np.stack([frames, frames + 1], axis=1)[kept] * num_cameras + cameras[kept, None]
    return Keypoints(
        points=points[kept],
        track_lengths=np.full(len(kept), 2),
        track_images=images.reshape(-1),
        track_pixels=np.stack([pixels, seen_pixels], axis=1)[kept].reshape(-1, 2),
    )


def _ordered(parts: list[Keypoints], rng: np.random.Generator) -> Keypoints:
    """All points in the order of their first images, as a mapper adds them."""
    points = np.concatenate([part.points for part in parts])
    lengths = np.concatenate([part.track_lengths for part in parts])
    images = np.concatenate([part.track_images for part in parts])
    pixels = np.concatenate([part.track_pixels for part in parts])
    firsts = np.minimum.reduceat(images, np.append(0, np.cumsum(lengths)[:-1]))
    rank = np.empty(len(points), dtype=np.int64)
    order = np.argsort(firsts, kind="stable")
    rank[order] = np.arange(len(points))
    elements = np.lexsort((images, np.repeat(rank, lengths)))
    noisy = pixels[elements] + rng.normal(0.0, _PIXEL_NOISE_PX, pixels.shape)
    return Keypoints(
        points=points[order], track_lengths=lengths[order], track_images=images[elements], track_pixels=noisy
    )
