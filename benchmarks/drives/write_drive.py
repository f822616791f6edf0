"""A preset -> a COLMAP model."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.drives.district import drive_route, make_district, path_of
from benchmarks.drives.keypoints import make_keypoints
from benchmarks.drives.model_file import ModelWriter
from benchmarks.drives.presets import Preset
from benchmarks.drives.surfaces import make_surfaces
from benchmarks.drives.vehicle import drive

_DISTRICT_PITCH_M = 720.0


def write_drive(preset: Preset, folder: Path) -> None:
    """Simulate the drives of a preset and write them as one binary COLMAP model, z up, metres.

    Districts lie beside each other in a square, each turned by an angle of its own. The same preset gives the same
    bytes; memory follows one district.
    """
    writer = ModelWriter(folder)
    side = math.ceil(math.sqrt(preset.num_districts))
    for number in range(preset.num_districts):
        rng = np.random.default_rng([preset.seed, number])
        district = make_district(preset.num_streets, preset.street_spacing_m, preset.house_share, rng)
        route = drive_route(district, preset.num_keyframes * preset.keyframe_spacing_m, rng)
        keyframes = drive(path_of(district, route), preset.num_keyframes, preset.keyframe_spacing_m, rng)
        surfaces = make_surfaces(district, route, keyframes.centers_m, preset.num_points, rng)
        keypoints = make_keypoints(district, surfaces, keyframes, preset.num_points, rng)
        place = _DISTRICT_PITCH_M * np.array([number % side, number // side])
        writer.add(keyframes, keypoints, _placed(keyframes.centers_m, place, rng.uniform(0.0, 2 * math.pi)), rng)
    writer.close()


def _placed(centers: NDArray[np.float64], place: NDArray[np.float64], angle: float) -> NDArray[np.float64]:
    """(3, 4) turn about the vertical, and move the middle of the drive to ``place``."""
    cos, sin = math.cos(angle), math.sin(angle)
    rotation = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    middle = np.array([*((centers.min(axis=0) + centers.max(axis=0)) / 2)[:2], 0.0])
    return np.column_stack([rotation, np.array([*place, 0.0]) - rotation @ middle])
