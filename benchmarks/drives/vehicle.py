"""A vehicle on its path: speed, stops, 30 Hz video, keyframes by distance, and a rig of seven cameras."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.drives.district import ground_height

FRAME_RATE_HZ = 30.0
IMAGE_SIZE_PX = (3840, 1920)
CAMERAS = ("front", "front_left", "front_right", "left", "right", "rear_left", "rear_right")
_YAWS_DEG = (0.0, 50.0, -50.0, 100.0, -100.0, 152.0, -152.0)
_FIELDS_OF_VIEW_DEG = (60.0, 70.0, 70.0, 70.0, 70.0, 70.0, 70.0)
_MOUNTS_M = ((0.6, 0.0), (0.4, 0.6), (0.4, -0.6), (0.0, 0.7), (0.0, -0.7), (-0.6, 0.6), (-0.6, -0.6))
"""Ahead and left of the vehicle's centre."""
_MOUNT_HEIGHT_M = 1.9
_ACCELERATION_M_S2 = 1.8
_LATERAL_ACCELERATION_M_S2 = 2.5
_STOPS_PER_M = 1 / 250
_MEAN_STOP_S = 12.0


def focal_lengths_px() -> NDArray[np.float64]:
    """(7,) from the horizontal fields of view."""
    lengths: NDArray[np.float64] = IMAGE_SIZE_PX[0] / 2 / np.tan(np.radians(_FIELDS_OF_VIEW_DEG) / 2)
    return lengths


@dataclass(frozen=True, kw_only=True)
class Keyframes:
    """F keyframes of a drive and their 7 F images, in the district's frame. z up, metres."""

    frame_numbers: NDArray[np.int64]
    """(F,) in the 30 Hz video."""
    centers_m: NDArray[np.float64]
    """(F, 3) of the vehicle at the height of its cameras."""
    cam_from_district: NDArray[np.float64]
    """(F, 7, 3, 4) [R | t]."""

    @property
    def image_from_district(self) -> NDArray[np.float64]:
        """(F, 7, 3, 4) K [R | t]."""
        matrices = self.cam_from_district.copy()
        matrices[:, :, :2] *= focal_lengths_px()[:, None, None]
        matrices[:, :, :2] += np.array(IMAGE_SIZE_PX)[:, None] / 2 * self.cam_from_district[:, :, 2:]
        return matrices


def drive(path: NDArray[np.float64], num_keyframes: int, spacing_m: float, rng: np.random.Generator) -> Keyframes:
    """Drive along a path and keep the first video frame after every so many metres.

    Args:
        path: (n, 2) dense positions.
        num_keyframes: F.
        spacing_m: Between keyframes; while the vehicle stands there is none.
        rng: Of the speeds, the stops and the shaking.
    """
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    distance_at_frame = _video(path, along, rng)
    frames = np.searchsorted(distance_at_frame, spacing_m * np.arange(num_keyframes))
    distances = distance_at_frame[frames]
    positions = np.stack([np.interp(distances, along, path[:, axis]) for axis in range(2)], axis=1)
    before, after = (
        np.stack([np.interp(distances + offset, along, path[:, axis]) for axis in range(2)], axis=1)
        for offset in (-1.0, 1.0)
    )
    ahead = np.column_stack([after - before, ground_height(after) - ground_height(before)])
    centers = np.column_stack([positions, ground_height(positions) + _MOUNT_HEIGHT_M])
    return Keyframes(
        frame_numbers=frames, centers_m=centers, cam_from_district=_camera_poses(centers, _shaken_axes(ahead, rng))
    )


def _video(path: NDArray[np.float64], along: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Distance driven at each frame of the video, by curvature, stops and limits, with bounded acceleration."""
    ahead = np.gradient(path, along, axis=0)
    heading = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    curvature = np.abs(np.gradient(heading, along))
    limits = np.repeat(rng.uniform(8.0, 14.0, len(along) // 400 + 1), 400)[: len(along)]
    speeds = np.minimum(limits, np.sqrt(_LATERAL_ACCELERATION_M_S2 / np.maximum(curvature, 1e-3)))
    stops = rng.choice(len(along), max(1, round(along[-1] * _STOPS_PER_M)), replace=False)
    speeds[stops] = 0.3
    # v^2 may change by 2 a per metre: the least over all places of v^2 + 2 a * distance.
    squared, slope = speeds**2, 2 * _ACCELERATION_M_S2 * along
    squared = np.minimum.accumulate(squared - slope) + slope
    squared = np.minimum.accumulate((squared + slope)[::-1])[::-1] - slope
    speeds = np.sqrt(squared)
    standing = np.zeros(len(along))
    standing[stops] = rng.exponential(_MEAN_STOP_S, len(stops))
    moving = np.diff(along) / (0.5 * (speeds[1:] + speeds[:-1]))
    arrivals = np.concatenate([[0.0], np.cumsum(standing[:-1] + moving)])
    times = np.stack([arrivals, arrivals + standing], axis=1).reshape(-1)
    frame_times = np.arange(0.0, times[-1], 1 / FRAME_RATE_HZ)
    distances: NDArray[np.float64] = np.interp(frame_times, times, np.repeat(along, 2))
    return distances


def _shaken_axes(ahead: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """(F, 3, 3) columns ahead, left, up of the vehicle, with half a degree of roll and pitch."""
    ahead = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    tilted = np.array([0.0, 0.0, 1.0]) + rng.normal(0.0, np.radians(0.5), (len(ahead), 3))
    left = np.cross(tilted, ahead)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    return np.stack([ahead, left, np.cross(ahead, left)], axis=2)


def _camera_poses(centers: NDArray[np.float64], axes: NDArray[np.float64]) -> NDArray[np.float64]:
    """(F, 7, 3, 4) cam_from_district."""
    yaws = np.radians(_YAWS_DEG)
    cos, sin, zero, one = np.cos(yaws), np.sin(yaws), np.zeros(7), np.ones(7)
    # Rows right, down, ahead of each camera, on the vehicle's axes ahead, left, up.
    cam_from_vehicle = np.stack(
        [np.stack([sin, -cos, zero], 1), np.stack([zero, zero, -one], 1), np.stack([cos, sin, zero], 1)], axis=1
    )
    rotations = np.einsum("cij,fkj->fcik", cam_from_vehicle, axes)
    mounts = np.column_stack([_MOUNTS_M, zero])
    camera_centers = centers[:, None] + np.einsum("fij,cj->fci", axes, mounts)
    translations = -np.einsum("fcij,fcj->fci", rotations, camera_centers)
    return np.concatenate([rotations, translations[..., None]], axis=3)
