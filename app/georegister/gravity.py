"""Which way is up: from how the cameras are held, from the ground under them, and from GPS heights, weighted together.

Each source adds a quadratic term to the log likelihood of the unit vector ``up``; straight drives leave some of them
blind about one axis (GPS about the roll about the path, one camera's horizontality about its pitch), never all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.scene.posed_scene import PosedScene

_CAMERA_ROLL_SIGMA_DEG = 2.0
"""How far a camera's x axis may be off the horizontal: mounting and the road's cross slope."""
_CAMERA_PITCH_SIGMA_DEG = 8.0
"""How far the common up direction may lean: cameras are often mounted looking a little down."""
_GROUND_SIGMA_DEG = 1.5
"""How far a road's average normal may be off the vertical."""
_MAX_LEANING_DEG = 60.0
_MIN_COMMON_UP = 0.3
_MAX_GROUND_TILT_DEG = 20.0
_MIN_DEPRESSION_DEG, _MAX_DEPRESSION_DEG = 8.0, 80.0
_MAX_OBSERVATIONS = 1_000_000
_MAX_GROUND_POINTS = 20_000
_GROUND_TRIALS = 1_000
_GROUND_TOLERANCE = 0.06
"""Distance from the ground plane, in camera heights."""
_MIN_GROUND_POINTS = 40
_MIN_GROUND_SHARE = 0.15


@dataclass(frozen=True, kw_only=True)
class UpTerm:
    """The log likelihood -1/2 up^T A up + b^T up of the up direction, angles in radians."""

    matrix: NDArray[np.float64]
    """(3, 3) A"""
    vector: NDArray[np.float64]
    """(3,) b"""

    def __add__(self, other: UpTerm) -> UpTerm:
        return UpTerm(matrix=self.matrix + other.matrix, vector=self.vector + other.vector)


@dataclass(frozen=True, kw_only=True)
class GroundPlane:
    """The ground relative to the cameras: ``normal . offset = -height`` for offsets from a camera to the ground."""

    normal_in_model: NDArray[np.float64]
    """(3,) unit, up."""
    height: float
    """Of the cameras over the ground, model units."""
    inlier_share: float
    """Of the points below the cameras."""


def solve_up(term: UpTerm, start: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Most likely unit vector, by Newton's method on the sphere.

    Args:
        term: sum of all terms.
        start: (3,) unit vector near the solution.

    Returns:
        (3,) unit vector, and the standard deviation about its least certain axis in degrees.
    """
    up = start
    for _ in range(20):
        basis = _tangent_basis(up)
        gradient = term.matrix @ up - term.vector
        hessian = basis.T @ term.matrix @ basis
        # The sphere's curvature adds to the Hessian; where that makes it indefinite Gauss-Newton still descends.
        curved = hessian - float(up @ gradient) * np.eye(2)
        if np.linalg.eigvalsh(curved)[0] > 0.0:
            hessian = curved
        step = -basis @ np.linalg.solve(hessian + 1e-12 * np.eye(2), basis.T @ gradient)
        up = up + step
        up = up / np.linalg.norm(up)
        if float(np.linalg.norm(step)) < 1e-12:
            break
    basis = _tangent_basis(up)
    weakest = float(np.linalg.eigvalsh(basis.T @ term.matrix @ basis)[0])
    return up, float(np.degrees(1.0 / np.sqrt(max(weakest, 1e-6))))


def up_from_cameras(
    rotations: NDArray[np.float64], cameras: NDArray[np.int64]
) -> tuple[NDArray[np.float64], UpTerm] | None:
    """Up direction from images held upright: their x axes are horizontal, and their -y axes agree on up.

    All images of one camera count as one observation, since its mounting error is in all of them.

    Args:
        rotations: (N, 3, 3) cam_from_world.
        cameras: (N,) camera of each image.

    Returns:
        (3,) unit vector in the model's frame and its term, or None where the images have no common up direction.
    """
    ups = -rotations[:, 1, :]
    common = ups.mean(axis=0)
    if np.linalg.norm(common) < _MIN_COMMON_UP:
        return None
    common = common / np.linalg.norm(common)
    upright = np.ones(len(ups), dtype=np.bool_)
    for _ in range(10):
        upright = ups @ common > np.cos(np.radians(_MAX_LEANING_DEG))
        if not upright.any():
            return None
        common = ups[upright].mean(axis=0)
        common = common / np.linalg.norm(common)
    term = direction_term(common, _CAMERA_PITCH_SIGMA_DEG)
    matrix = np.zeros((3, 3))
    for camera in np.unique(cameras[upright]):
        axes = rotations[upright & (cameras == camera), 0, :]
        matrix += axes.T @ axes / len(axes) / np.radians(_CAMERA_ROLL_SIGMA_DEG) ** 2
    term = term + UpTerm(matrix=matrix, vector=np.zeros(3))
    return solve_up(term, common)[0], term


def ground_term(ground: GroundPlane) -> UpTerm:
    """Up is the ground's normal, as far as roads are level."""
    return direction_term(ground.normal_in_model, _GROUND_SIGMA_DEG)


def heights_term(
    positions: NDArray[np.float64], heights: NDArray[np.float64], weights: NDArray[np.float64], sigma: float
) -> UpTerm:
    """Up is where the heights grow.

    Args:
        positions: (F, 3) in the model's frame, scaled to metres.
        heights: (F,) metres.
        weights: (F,) 0 for outliers.
        sigma: standard deviation of one height in metres, as large as the mean of correlated ones asks for.
    """
    total = weights.sum()
    centered = positions - weights @ positions / total
    offsets = heights - weights @ heights / total
    weighted = centered * weights[:, None] / sigma**2
    return UpTerm(matrix=weighted.T @ centered, vector=weighted.T @ offsets)


def find_ground(scene: PosedScene, up: NDArray[np.float64], *, seed: int) -> GroundPlane | None:
    """Ground plane by RANSAC over the sparse points below the cameras.

    Points are taken relative to the camera that sees them, which makes one plane of a road that climbs and falls, and
    of a model that bends: the cameras' height over it is what stays the same. All thresholds are angles or shares of
    that height, so the scale doesn't matter.

    Args:
        scene: the model.
        up: (3,) unit vector, right within 20 degrees.
        seed: of the sampling.

    Returns:
        The plane, or None if too few points agree on one.
    """
    rng = np.random.default_rng(seed)
    rays = _rays_down(scene, up, rng)
    if len(rays) > _MAX_GROUND_POINTS:
        rays = rays[np.sort(rng.choice(len(rays), _MAX_GROUND_POINTS, replace=False))]
    if len(rays) < _MIN_GROUND_POINTS:
        return None
    triples = rays[rng.integers(0, len(rays), (_GROUND_TRIALS, 3))]
    normals = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    normals = normals[lengths > 0.0] / lengths[lengths > 0.0, None]
    normals *= np.sign(normals @ up)[:, None]
    heights = -np.einsum("ni,ni->n", normals, triples[lengths > 0.0, 0])
    usable = (normals @ up > np.cos(np.radians(_MAX_GROUND_TILT_DEG))) & (heights > 0.0)
    best, best_score = None, 0.0
    for normal, height in zip(normals[usable], heights[usable], strict=True):
        residual = np.abs(rays @ normal + height) / (_GROUND_TOLERANCE * height)
        score = float(np.maximum(1.0 - residual**2, 0.0).sum())
        if score > best_score:
            best, best_score = (normal, float(height)), score
    if best is None:
        return None
    normal, height = best
    for _ in range(10):
        inliers = np.abs(rays @ normal + height) < _GROUND_TOLERANCE * height
        if inliers.sum() < _MIN_GROUND_POINTS:
            return None
        points = rays[inliers]
        _, _, axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
        normal = axes[2] * np.sign(axes[2] @ up)
        height = float(-normal @ points.mean(axis=0))
    share = float(inliers.mean())
    if height <= 0.0 or share < _MIN_GROUND_SHARE or normal @ up < np.cos(np.radians(_MAX_GROUND_TILT_DEG)):
        return None
    return GroundPlane(normal_in_model=normal, height=height, inlier_share=share)


def angle_deg(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Angle between two unit vectors."""
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(first, second)), first @ second)))


def _rays_down(scene: PosedScene, up: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """(R, 3) offsets from cameras to the points that they see well below their horizon."""
    observations = np.arange(len(scene.track_images))
    if len(observations) > _MAX_OBSERVATIONS:
        observations = np.sort(rng.choice(len(observations), _MAX_OBSERVATIONS, replace=False))
    points = np.searchsorted(scene.track_offsets, observations, side="right") - 1
    rays = scene.points_in_world[points] - scene.centers_in_world[scene.track_images[observations]]
    lengths = np.linalg.norm(rays, axis=1)
    sines = -(rays @ up) / np.where(lengths > 0.0, lengths, 1.0)
    low, high = np.sin(np.radians((_MIN_DEPRESSION_DEG, _MAX_DEPRESSION_DEG)))
    down: NDArray[np.float64] = rays[(sines > low) & (sines < high)]
    return down


def direction_term(direction: NDArray[np.float64], sigma_deg: float) -> UpTerm:
    information = 1.0 / np.radians(sigma_deg) ** 2
    return UpTerm(matrix=information * np.eye(3), vector=information * direction)


def _tangent_basis(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 2) orthonormal vectors across ``up``."""
    _, _, axes = np.linalg.svd(up[None, :])
    basis: NDArray[np.float64] = axes[1:].T
    return basis
