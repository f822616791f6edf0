"""What surfaces look like: albedo from noise tiles, patterns and the plan of the roads, per ray hit.

Noise comes from two periodic tiles of different texel size, sampled with bilinear interpolation at the level of detail
that fits a pixel's footprint, so that a surface looks the same from near and from afar.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from sample_data.street_path import RoadPlan

Floats = NDArray[np.float32]

_TILE = 2048
_LEVELS = 6
_FINE_TEXEL_M, _COARSE_TEXEL_M = 0.011, 0.037
_FIELD_CELL_M = 0.5
SIDEWALK_M = 2.0
_CURB_STONE_M = 0.16


class Kind(IntEnum):
    """Materials."""

    GROUND = 0
    BRICK = 1
    PLASTER = 2
    PLAIN = 3
    ROOF = 4
    GLASS = 5
    WOOD = 6
    PAINT = 7
    LEAVES = 8
    STONE = 9


@dataclass(frozen=True)
class Surfaces:
    """Table of materials: one row per surface."""

    kind: NDArray[np.int8]
    """(S,) `Kind`."""
    color: Floats
    """(S, 3) albedo in red, green, blue, 0..1."""
    contrast: Floats
    """(S,) strength of the noise."""
    shift_m: Floats
    """(S, 2) where in the noise this surface begins."""
    turn: NDArray[np.int8]
    """(S,) 0..7: how the noise is turned and mirrored."""


@lru_cache(maxsize=2)
def noise_pyramid(seed: int) -> tuple[Floats, ...]:
    """Periodic noise, finest level first: (N, N, 3) of detail at all scales, spots, and broad stains, about -1..1."""
    rng = np.random.default_rng(seed)
    frequency = np.hypot(np.fft.fftfreq(_TILE)[:, None], np.fft.rfftfreq(_TILE)[None, :])
    frequency[0, 0] = 1.0

    def shaped(gain: NDArray[np.float64]) -> Floats:
        gain[0, 0] = 0.0
        spectrum = np.fft.rfft2(rng.standard_normal((_TILE, _TILE), dtype=np.float32)) * gain
        values = np.fft.irfft2(spectrum, s=(_TILE, _TILE)).astype(np.float32)
        return np.asarray(values / values.std(), dtype=np.float32)

    detail = shaped(frequency**-0.9 * (frequency > 1 / 400))
    band = shaped(np.exp(-(((np.log2(frequency) + 3.6) / 0.5) ** 2)))
    spots = np.clip((np.abs(band) - 1.9) * 3, 0, 1) * np.sign(band)
    stains = shaped(frequency**-1.9)
    level = np.stack([np.clip(detail / 2.2, -1, 1), spots, np.clip(stains / 2.2, -1, 1)], axis=2).astype(np.float32)
    levels = [level]
    for _ in range(_LEVELS - 1):
        half = cv2.resize(levels[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        levels.append(np.asarray(half, dtype=np.float32))
    return tuple(levels)


def _remap(image: Floats, x: Floats, y: Floats, border: int) -> Floats:
    """Bilinear values (N, channels) of an image at pixel coordinates; texel centres are at integers."""
    width = 1024
    pad = -len(x) % width
    grid = [np.pad(values, (0, pad)).reshape(-1, width) for values in (x, y)]
    if len(grid[0]) == 0:
        return np.zeros((0, image.shape[2]), dtype=np.float32)
    values = cv2.remap(image, grid[0], grid[1], cv2.INTER_LINEAR, borderMode=border)
    return np.asarray(values.reshape(-1, image.shape[2])[: len(x)])


def sample_noise(pyramid: tuple[Floats, ...], uv_m: Floats, footprint_m: Floats, texel_m: float) -> Floats:
    """Noise (N, 3) at places (N, 2) in metres, with the level of detail that fits the footprints (N,)."""
    level = np.clip(np.rint(np.log2(np.maximum(footprint_m, 1e-4) / texel_m)), 0, _LEVELS - 1).astype(np.int8)
    values = np.empty((len(uv_m), 3), dtype=np.float32)
    for index, image in enumerate(pyramid):
        here = np.flatnonzero(level == index)
        size = image.shape[0]
        coordinates = np.mod(uv_m[here] / np.float32(texel_m * 2**index), size).astype(np.float32) - 0.5
        values[here] = _remap(image, coordinates[:, 0], coordinates[:, 1], cv2.BORDER_WRAP)
    return values


class RoadField:
    """Distance from the roads' edges and position along the axes, on a raster."""

    def __init__(self, plan: RoadPlan, margin_m: float) -> None:
        """Compute the raster for all roads of a plan, with a margin around their axes."""
        corners = np.concatenate([road.axis.points for road in plan.roads])
        self.low = np.floor(corners.min(axis=0) - margin_m)
        self.high = np.ceil(corners.max(axis=0) + margin_m)
        n_x, n_y = ((self.high - self.low) / _FIELD_CELL_M).astype(int) + 1
        xs = self.low[0] + _FIELD_CELL_M * np.arange(n_x)
        ys = self.low[1] + _FIELD_CELL_M * np.arange(n_y)
        xy = np.stack(np.meshgrid(xs, ys), axis=2).reshape(-1, 2)
        best = np.full(len(xy), np.inf)
        values = np.zeros((len(xy), 4), dtype=np.float32)
        for road in plan.roads:
            for start in range(0, len(xy), 4_000):
                part = slice(start, start + 4_000)
                chunk = xy[part]
                squared, square_y = (
                    np.square((chunk[:, axis, None] - road.axis.points[None, ::2, axis]).astype(np.float32))
                    for axis in (0, 1)
                )
                squared += square_y
                nearest = 2 * squared.argmin(axis=1)
                heading = road.axis.headings[nearest]
                offset = chunk - road.axis.points[nearest]
                along = offset[:, 0] * np.cos(heading) + offset[:, 1] * np.sin(heading)
                across = offset[:, 1] * np.cos(heading) - offset[:, 0] * np.sin(heading)
                is_end = (nearest == 0) | (nearest >= len(road.axis.points) - 2)
                is_end &= not road.is_closed
                distance = np.where(is_end, np.hypot(along, across), np.abs(across))
                edge = distance - road.half_width_m
                wins = edge < best[part]
                best[part][wins] = edge[wins]
                row = np.stack([edge, across, road.axis.lengths[nearest] + along], axis=1)
                values[part][wins, :3] = row[wins]
                values[part][wins, 3] = float(road.has_centre_line)
        self.raster = np.ascontiguousarray(values.reshape(n_y, n_x, 4))

    def sample(self, xy: NDArray[np.floating]) -> Floats:
        """Distance beyond the road's edge, offset to the left of the axis, arc length, centre line or not: (N, 4)."""
        x, y = (((xy[:, axis] - self.low[axis]) / _FIELD_CELL_M).astype(np.float32) for axis in (0, 1))
        return _remap(self.raster, x, y, cv2.BORDER_REPLICATE)


def _line(distance_m: Floats, width_m: float, footprint_m: Floats) -> Floats:
    """Share of a footprint that a line covers, at a distance from the line's middle."""
    soft = np.maximum(footprint_m, 0.004)
    cover = np.clip((width_m / 2 - np.abs(distance_m)) / soft + 0.5, 0, 1)
    return np.asarray(cover * np.minimum(1, 2 * width_m / soft), dtype=np.float32)


def _periodic(position_m: Floats, period_m: float) -> Floats:
    """Signed distance to the nearest multiple of the period."""
    return np.asarray(position_m - period_m * np.rint(position_m / period_m), dtype=np.float32)


def _cell_tone(i: Floats, j: Floats) -> Floats:
    """Pseudo-random tone -1..1 of a brick or slab from its indices."""
    a = i.astype(np.int64).astype(np.uint64) * np.uint64(73856093) ^ j.astype(np.int64).astype(np.uint64) * np.uint64(
        19349663
    )
    a = (a ^ (a >> np.uint64(13))) * np.uint64(0x5BD1E995)
    return np.asarray((a & np.uint64(0xFFFF)).astype(np.float32) / 32767.5 - 1, dtype=np.float32)


def _bricks(uv: Floats, footprint: Floats, width_m: float, height_m: float, joint_m: float) -> tuple[Floats, Floats]:
    """Tone of each brick (-1..1) and share of mortar, for bricks laid with half a brick's shift from row to row."""
    row = np.floor(uv[:, 1] / height_m)
    u = uv[:, 0] + np.mod(row, 2) * width_m / 2
    tone = _cell_tone(np.floor(u / width_m), row) * np.clip(1.5 - footprint / height_m, 0, 1)
    joint = np.maximum(
        _line(_periodic(u, width_m), joint_m, footprint), _line(_periodic(uv[:, 1], height_m), joint_m, footprint)
    )
    return tone, joint * np.clip(2 - footprint / height_m, 0.2, 1)


def _ground(xyz: Floats, noise: Floats, coarse: Floats, footprint: Floats, field: RoadField, richness: float) -> Floats:
    """Albedo (N, 3) of road, markings, curbs, paving and grass."""
    edge, across, along, centre = field.sample(xyz[:, :2]).T
    grain = richness * (0.42 * noise[:, 0] + 0.24 * coarse[:, 0] + 0.42 * noise[:, 1] + 0.36 * coarse[:, 1])
    crack = _line(coarse[:, 2] * 1.1, 0.02, footprint * 0.5)
    patch = (coarse[:, 2] > 0.55).astype(np.float32)
    tone = 0.42 * (1 + grain) * (1 - richness * (0.4 * crack + 0.18 * patch))
    dash = (np.mod(along, 6.0) < 3.2).astype(np.float32) * (centre > 0.99)
    bay = _line(np.abs(across) - 3.15, 0.10, footprint) + _line(_periodic(along, 5.6), 0.1, footprint) * (
        np.abs(across) > 3.15
    )
    paint = np.clip(_line(across, 0.14, footprint) * dash + bay * (centre > 0.99), 0, 1)
    paint *= np.clip(0.9 - richness * 1.2 * np.clip(noise[:, 0] + coarse[:, 0] - 0.35, 0, 1), 0, 1)
    road = tone[:, None] * np.array([1.0, 1.0, 1.03], dtype=np.float32)
    albedo = road * (1 - paint[:, None]) + paint[:, None] * 0.85
    raised = xyz[:, 2] > 0.01
    slab, joint = _bricks(xyz[:, :2], footprint, 0.5, 0.5, 0.014)
    paving = (0.55 + 0.10 * slab * richness + 0.7 * grain * 0.5) * (1 - 0.45 * joint)
    is_paving = raised & (edge >= _CURB_STONE_M) & (edge < SIDEWALK_M)
    albedo[is_paving] = paving[is_paving, None] * np.array([1.0, 0.95, 0.88], dtype=np.float32)
    stone = (0.66 + 0.35 * grain) * (1 - 0.5 * _line(_periodic(along, 1.0), 0.015, footprint))
    is_stone = raised & (edge < _CURB_STONE_M)
    albedo[is_stone] = stone[is_stone, None]
    is_grass = edge >= SIDEWALK_M
    green = 0.38 * (1 + 1.6 * grain)
    albedo[is_grass] = green[is_grass, None] * np.array([0.85, 1.0, 0.5], dtype=np.float32)
    return np.asarray(albedo, dtype=np.float32)


def _built(kind: Kind, uv: Floats, noise: Floats, coarse: Floats, contrast: Floats, footprint: Floats) -> Floats:
    """Factor (N,) on a surface's own colour."""
    grain = 0.40 * noise[:, 0] + 0.34 * coarse[:, 0] + 0.50 * noise[:, 1] + 0.45 * coarse[:, 1]
    stain = 0.16 * coarse[:, 2]
    if kind is Kind.BRICK:
        tone, joint = _bricks(uv, footprint, 0.25, 0.085, 0.014)
        return np.asarray((1 + contrast * (0.28 * tone + 0.6 * grain + stain)) * (1 - 0.3 * joint), dtype=np.float32)
    if kind is Kind.STONE:
        tone, joint = _bricks(uv, footprint, 0.62, 0.31, 0.02)
        return np.asarray((1 + contrast * (0.22 * tone + 0.9 * grain + stain)) * (1 - 0.4 * joint), dtype=np.float32)
    if kind is Kind.ROOF:
        ridge = 0.2 * np.cos(uv[:, 0] * (2 * np.pi / 0.22)) * np.clip(1.5 - footprint / 0.1, 0, 1)
        row = _line(_periodic(uv[:, 1], 0.35), 0.03, footprint)
        return np.asarray((1 + ridge + contrast * (0.8 * grain + stain)) * (1 - 0.4 * row), dtype=np.float32)
    if kind is Kind.WOOD:
        slat = _line(_periodic(uv[:, 1], 0.09), 0.02, footprint)
        return np.asarray((1 + contrast * 0.5 * grain) * (1 - 0.45 * slat), dtype=np.float32)
    if kind is Kind.GLASS:
        curtain = 0.5 + 0.5 * np.cos(uv[:, 0] * 23.0 + 3 * coarse[:, 2])
        shape = (np.abs(_periodic(uv[:, 0] + 0.3 * coarse[:, 2], 1.3)) > 0.3).astype(np.float32)
        return np.asarray(0.7 + shape * (0.8 + 0.6 * curtain) + 0.5 * noise[:, 2], dtype=np.float32)
    if kind is Kind.PAINT:
        seam = _line(uv[:, 0] - 0.35, 0.02, footprint) + _line(uv[:, 0] + 0.75, 0.02, footprint)
        return np.asarray(1 + 0.10 * contrast * grain - 0.5 * np.clip(seam, 0, 1), dtype=np.float32)
    if kind is Kind.LEAVES:
        return np.asarray(0.9 + 1.1 * noise[:, 0] + 0.5 * coarse[:, 0], dtype=np.float32)
    return np.asarray(1 + contrast * (grain + stain), dtype=np.float32)


def albedo(
    xyz: Floats,
    uv_m: Floats,
    surface: NDArray[np.int32],
    footprint_m: Floats,
    *,
    surfaces: Surfaces,
    field: RoadField,
    richness: float,
    seed: int,
) -> Floats:
    """Albedo (N, 3), 0..1, of ray hits.

    Args:
        xyz: (N, 3) hits in the world.
        uv_m: (N, 2) coordinates on the surface in metres.
        surface: (N,) row in the table of surfaces.
        footprint_m: (N,) size of a pixel's image on the surface.
        surfaces: The table of surfaces.
        field: The plan of the roads.
        richness: Strength of the road's texture, 0..1.
        seed: Of the noise.
    """
    pyramid = noise_pyramid(seed)
    turn = surfaces.turn[surface]
    turned = np.where((turn & 4)[:, None] > 0, uv_m[:, ::-1], uv_m)
    turned = turned * np.stack([1 - (turn & 2), 1 - 2 * (turn & 1)], axis=1).astype(np.float32)
    turned = turned + surfaces.shift_m[surface]
    noise = sample_noise(pyramid, turned, footprint_m, _FINE_TEXEL_M)
    slanted = turned @ np.array([[0.8, 0.6], [-0.6, 0.8]], dtype=np.float32)
    coarse = sample_noise(pyramid, slanted, footprint_m, _COARSE_TEXEL_M)
    kinds = surfaces.kind[surface]
    result = np.empty((len(xyz), 3), dtype=np.float32)
    for kind in Kind:
        here = np.flatnonzero(kinds == kind)
        if len(here) == 0:
            continue
        if kind is Kind.GROUND:
            result[here] = _ground(xyz[here], noise[here], coarse[here], footprint_m[here], field, richness)
            continue
        rows = surface[here]
        factor = _built(kind, uv_m[here], noise[here], coarse[here], surfaces.contrast[rows], footprint_m[here])
        result[here] = surfaces.color[rows] * factor[:, None]
    return np.clip(result, 0.01, 1.0)
