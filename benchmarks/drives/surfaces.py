"""Where the keypoints of a district lie: on small rectangles with much texture, and on large ones with little."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.drives.district import District, Node, ground_height, street

_FRONT_LENGTH_M = 12.0
_RICHNESS_SHAPE = 0.35
"""Of the gamma distribution of a front's or a stretch's texture; small: a few rich ones, many almost empty ones."""
_POINTS_PER_PATCH = 40
_SHARES = {"patches": 0.64, "fronts": 0.12, "markings": 0.12, "road": 0.03, "furniture": 0.09}
_STRETCH_KEYFRAMES = 10


@dataclass(frozen=True, kw_only=True)
class Surfaces:
    """R rectangles, evenly filled with points."""

    centers: NDArray[np.float64]
    """(R, 3)"""
    half_axes: NDArray[np.float64]
    """(R, 2, 3) from the centre to the middle of two sides."""
    normals: NDArray[np.float64]
    """(R, 3)"""
    weights: NDArray[np.float64]
    """(R,) share of the points; they sum to 1."""

    def draw(self, count: int, rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(count, 3) points, up to some decimetres in front of their surface, and its normals."""
        chosen = rng.choice(len(self.weights), count, p=self.weights)
        within = rng.uniform(-1.0, 1.0, (count, 2))
        outward = np.abs(rng.normal(0.0, 0.1, count))
        points = self.centers[chosen] + np.einsum("na,nai->ni", within, self.half_axes[chosen])
        return points + outward[:, None] * self.normals[chosen], self.normals[chosen]


def make_surfaces(
    district: District, route: list[Node], centers: NDArray[np.float64], num_points: int, rng: np.random.Generator
) -> Surfaces:
    """The surfaces along the streets that a drive takes.

    Args:
        district: Streets and houses.
        route: Crossings on the way.
        centers: (F, 3) of the vehicle.
        num_points: That the surfaces will get; the number of textured patches follows it.
        rng: Of places, sizes and richness.
    """
    fronts, front_heights = _fronts(district, route, rng)
    num_patches = max(10, num_points // _POINTS_PER_PATCH)
    parts = {
        "patches": _patches(fronts, front_heights, num_patches, rng),
        "fronts": fronts,
        "markings": _along_road(centers, num_patches // 4, rng, flat=True),
        "road": _whole_road(centers),
        "furniture": _along_road(centers, num_patches // 4, rng, flat=False),
    }
    return Surfaces(
        centers=np.concatenate([part.centers for part in parts.values()]),
        half_axes=np.concatenate([part.half_axes for part in parts.values()]),
        normals=np.concatenate([part.normals for part in parts.values()]),
        weights=np.concatenate([_SHARES[kind] * part.weights / part.weights.sum() for kind, part in parts.items()]),
    )


def _fronts(district: District, route: list[Node], rng: np.random.Generator) -> tuple[Surfaces, NDArray[np.float64]]:
    """House fronts and fences along the streets driven, and how high they are; the weights are areas."""
    rows = []
    driven = {street(a, b) for a, b in zip(route, route[1:], strict=False)}
    for (i, j), (i_end, _) in sorted(driven):
        axis = 0 if i_end > i else 1
        along, across = (i, j) if axis == 0 else (j, i)
        low, high = district.bounds_of(axis, along + 1)
        for side in (0, 1):
            block = (along + 1, across + side) if axis == 0 else (across + side, along + 1)
            edge = district.bounds_of(1 - axis, across + side)[1 - side]
            height = rng.uniform(5.0, 14.0) if district.is_house[block] else 1.6
            count = max(1, round((high - low) / _FRONT_LENGTH_M))
            half = (high - low) / count / 2
            for k in range(count):
                rows.append((axis, low + (2 * k + 1) * half, edge, half, height, 1.0 - 2.0 * side))
    axis, middle, edge, half, height, outward = np.array(rows).T
    across_x = axis == 1
    ground = np.where(across_x[:, None], np.stack([edge, middle], 1), np.stack([middle, edge], 1))
    zero = np.zeros(len(rows))
    return Surfaces(
        centers=np.column_stack([ground, ground_height(ground) + height / 2]),
        half_axes=np.stack(
            [
                np.stack([np.where(across_x, 0, half), np.where(across_x, half, 0), zero], 1),
                np.stack([zero, zero, height / 2], 1),
            ],
            axis=1,
        ),
        normals=np.stack([np.where(across_x, outward, 0), np.where(across_x, 0, outward), zero], 1),
        weights=half * height,
    ), height


def _patches(fronts: Surfaces, heights: NDArray[np.float64], count: int, rng: np.random.Generator) -> Surfaces:
    """Textured patches on fronts: windows, doors, signs."""
    richness = rng.gamma(_RICHNESS_SHAPE, 1.0, len(heights)) * fronts.weights
    front = rng.choice(len(richness), count, p=richness / richness.sum())
    lengths = 2 * np.linalg.norm(fronts.half_axes[front, 0], axis=1)
    sizes = np.minimum(rng.uniform(0.2, 1.4, (count, 2)), np.stack([lengths, heights[front]], 1) / 2)
    room = 1.0 - sizes / np.stack([lengths, heights[front]], 1) * 2
    places = rng.uniform(-1.0, 1.0, (count, 2)) * room
    units = fronts.half_axes[front] / np.linalg.norm(fronts.half_axes[front], axis=2, keepdims=True)
    return Surfaces(
        centers=fronts.centers[front] + np.einsum("na,nai->ni", places, fronts.half_axes[front]),
        half_axes=units * sizes[:, :, None],
        normals=fronts.normals[front],
        weights=rng.lognormal(0.0, 1.0, count),
    )


def _along_road(centers: NDArray[np.float64], count: int, rng: np.random.Generator, *, flat: bool) -> Surfaces:
    """Markings on the road, or cars, trees and posts beside it, in rich and in empty stretches."""
    ahead, left = _road_axes(centers)
    richness = np.repeat(rng.gamma(_RICHNESS_SHAPE, 1.0, len(centers) // _STRETCH_KEYFRAMES + 1), _STRETCH_KEYFRAMES)
    richness = richness[: len(centers)]
    frame = rng.choice(len(centers), count, p=richness / richness.sum())
    sizes = rng.uniform(0.2, 1.0, (count, 2))
    side = rng.choice([-1.0, 1.0], count)
    lateral = rng.uniform(-4.0, 4.0, count) if flat else np.where(side > 0, 7.0, -4.0)
    ground = centers[frame, :2] + lateral[:, None] * left[frame] + rng.uniform(-2.0, 2.0, count)[:, None] * ahead[frame]
    zero, one = np.zeros(count), np.ones(count)
    up = np.column_stack([zero, zero, one])
    second = np.column_stack([left[frame], zero]) if flat else up
    return Surfaces(
        centers=np.column_stack([ground, ground_height(ground) + (0.0 if flat else 0.2) + zero])
        + (zero[:, None] if flat else up * sizes[:, 1:]),
        half_axes=np.stack([np.column_stack([ahead[frame], zero]), second], 1) * sizes[:, :, None],
        normals=up if flat else np.column_stack([-side[:, None] * left[frame], zero]),
        weights=rng.lognormal(0.0, 1.0, count),
    )


def _whole_road(centers: NDArray[np.float64]) -> Surfaces:
    """The road at every keyframe, 3 m along and 10 m across."""
    ahead, left = _road_axes(centers)
    zero = np.zeros(len(centers))
    return Surfaces(
        centers=np.column_stack([centers[:, :2], ground_height(centers)]),
        half_axes=np.stack([np.column_stack([1.5 * ahead, zero]), np.column_stack([5.0 * left, zero])], 1),
        normals=np.column_stack([zero, zero, zero + 1]),
        weights=zero + 1,
    )


def _road_axes(centers: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(F, 2) unit vectors ahead and left of the vehicle."""
    ahead = np.gradient(centers[:, :2], axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    return ahead, np.stack([-ahead[:, 1], ahead[:, 0]], 1)
