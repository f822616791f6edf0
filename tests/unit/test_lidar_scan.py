"""Judging clouds by sparse scans, in a corner of a room: floor z = 0 and the walls x = 0 and y = 0."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchmarks.alignment import fit_similarity, mean_rotation
from benchmarks.lidar_scan import fit_scans, surface_distances


def _corner(count: int, seed: int) -> NDArray[np.float32]:
    a, b = np.random.default_rng(seed).uniform(0, 6, (2, count))
    zero = np.zeros(count)
    return np.concatenate([np.stack(side, axis=1) for side in ((a, b, zero), (zero, a, b), (a, zero, b))]).astype(
        np.float32
    )


def test_distances_are_from_the_surface_between_the_rings() -> None:
    along, across = np.meshgrid(np.arange(0, 6, 0.05), np.arange(0, 6, 0.3), indexing="ij")
    rings = np.stack((along, across, np.zeros_like(along)), axis=-1).reshape(-1, 3).astype(np.float32)
    points = np.random.default_rng(0).uniform(1, 5, (500, 3)).astype(np.float32)
    points[:, 2] = 0.07
    distances = surface_distances(points, rings)
    assert np.isfinite(distances).mean() > 0.5
    np.testing.assert_allclose(distances[np.isfinite(distances)], 0.07, atol=1e-6)
    far = points + np.float32([0, 0, 0.6])
    assert np.isnan(surface_distances(far, rings)).all(), "who knows what the scan did not see there"


def test_a_single_ring_and_a_bush_are_no_surface() -> None:
    points = np.float32([[3.0, 0.1, 0.1]])
    along = np.arange(0, 6, 0.05, dtype=np.float32)
    ring = np.stack((along, 0 * along, 0 * along), axis=1)
    assert np.isnan(surface_distances(points, ring)).all()
    bush = np.random.default_rng(0).uniform(-0.5, 0.5, (300, 3)).astype(np.float32) + points
    assert np.isnan(surface_distances(points, bush)).all()


def test_a_scan_is_moved_onto_the_cloud() -> None:
    cloud, scan = _corner(8000, seed=1), _corner(2000, seed=2)
    turn = _turn(np.radians(1.5))
    shift = np.array([0.3, -0.2, 0.25])
    floaters = np.random.default_rng(3).uniform(1, 5, (500, 3)).astype(np.float32)
    moved = (scan @ turn.T + shift).astype(np.float32)
    ((rotation, translation),) = fit_scans([moved], np.concatenate([cloud, floaters]))
    np.testing.assert_allclose(rotation @ turn, np.eye(3), atol=1e-3)
    np.testing.assert_allclose(rotation @ shift + translation, 0, atol=5e-3)


def test_a_straight_drive_tells_its_roll_by_the_cameras() -> None:
    rng = np.random.default_rng(0)
    positions = np.column_stack((np.arange(20.0), np.zeros((20, 2)))) + rng.normal(0, 0.1, (20, 3))
    turns = np.stack([_turn(angle) for angle in rng.uniform(0, 6, 20)])
    roll = np.array([[1, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]])
    found_turns = np.stack([_turn(angle) for angle in rng.normal(0, 0.01, 20)]) @ roll.T @ turns
    rotation = mean_rotation(found_turns, turns)
    np.testing.assert_allclose(rotation, roll, atol=0.01)
    found_positions = (positions + rng.normal(0, 0.1, (20, 3))) @ roll
    scaled, translation = fit_similarity(found_positions * 1.05, positions, rotation)
    np.testing.assert_allclose(scaled, roll / 1.05, atol=0.02)
    np.testing.assert_allclose(translation, 0, atol=0.2)


def _turn(angle: float) -> NDArray[np.float64]:
    return np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
