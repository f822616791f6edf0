"""A procedural town around the roads of a drive: houses, parked cars, trees, lamps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sample_data.street_mesh import CURB_HEIGHT_M, Mesh, MeshBuilder, Placement, add_ground
from sample_data.street_path import PathKind, Road, RoadPlan, plan_roads
from sample_data.street_texture import SIDEWALK_M, Kind, RoadField

Floats = NDArray[np.float64]

_FIELD_MARGIN_M = 30.0
_PARKED_OFFSET_M = 4.2
_PATH_CLEARANCE_M = 2.3
_PLAIN_SHARE, _PLAIN_SHARE_POOR = 0.18, 0.75
_WALL_COLORS = (
    (0.80, 0.66, 0.46), (0.76, 0.52, 0.38), (0.82, 0.78, 0.68), (0.70, 0.62, 0.54), (0.84, 0.72, 0.56),
    (0.62, 0.64, 0.62), (0.74, 0.60, 0.58),
)  # fmt: skip
_BRICK_COLORS = ((0.58, 0.32, 0.25), (0.64, 0.42, 0.32), (0.52, 0.38, 0.32))
_CAR_COLORS = (
    (0.55, 0.10, 0.10), (0.12, 0.20, 0.42), (0.62, 0.63, 0.65), (0.85, 0.85, 0.83), (0.13, 0.13, 0.14),
    (0.25, 0.38, 0.30),
)  # fmt: skip


@dataclass(frozen=True)
class Town:
    """The scene and the drive through it."""

    plan: RoadPlan
    field: RoadField
    mesh: Mesh
    plain_share: float
    """Share of the walls' area that has no texture."""


class _TownBuilder:
    """Places things beside roads so that none stands in another or in the vehicle's way."""

    def __init__(self, plan: RoadPlan, field: RoadField, rng: np.random.Generator, richness: float) -> None:
        self.plan, self.field, self.rng = plan, field, rng
        self.richness = richness
        self.mesh = MeshBuilder(rng)
        self.footprints: list[Floats] = []
        self.wall_m2 = self.plain_m2 = 0.0
        self.frame_surfaces = [
            self.mesh.surface(Kind.STONE, tone, 0.5 * richness) for tone in ((0.85, 0.83, 0.78), (0.45, 0.33, 0.24))
        ]
        self.dark = self.mesh.surface(Kind.PLAIN, (0.06, 0.06, 0.07), 0.05)
        self.metal = self.mesh.surface(Kind.PLASTER, (0.30, 0.33, 0.33), 0.4)
        self.bark = self.mesh.surface(Kind.PLASTER, (0.38, 0.30, 0.22), 1.3)

    def choose(self, colors: tuple[tuple[float, float, float], ...]) -> tuple[float, float, float]:
        """Pick one of some colours and vary it a little."""
        r, g, b = np.asarray(colors[self.rng.integers(len(colors))]) * self.rng.uniform(0.9, 1.1)
        return float(r), float(g), float(b)

    def is_free(self, footprint: Floats, clearance_m: float) -> bool:
        """Whether a rectangle (4, 2) stays clear of all roads' edges and of the houses so far."""
        steps = np.linspace(0.0, 1.0, 9)[:, None]
        sides = [a + steps * (b - a) for a, b in zip(footprint, np.roll(footprint, -1, axis=0), strict=True)]
        inner = footprint.mean(axis=0) + 0.5 * (np.concatenate(sides) - footprint.mean(axis=0))
        if self.field.sample(np.concatenate([*sides, inner]))[:, 0].min() < clearance_m:
            return False
        return not any(_overlap(footprint, other) for other in self.footprints)

    def wall(self, area_m2: float) -> tuple[Kind, int]:
        """Material of a house's walls; keeps the plain share of the area near what is wanted."""
        share = _PLAIN_SHARE + (1 - self.richness) * (_PLAIN_SHARE_POOR - _PLAIN_SHARE)
        self.wall_m2 += area_m2
        if self.plain_m2 + 0.5 * area_m2 < share * self.wall_m2:
            self.plain_m2 += area_m2
            return Kind.PLAIN, self.mesh.surface(Kind.PLAIN, self.choose(_WALL_COLORS), 0.0)
        kind = (Kind.BRICK, Kind.PLASTER, Kind.PLASTER, Kind.STONE)[self.rng.integers(4)]
        color = self.choose(_BRICK_COLORS if kind is Kind.BRICK else _WALL_COLORS)
        return kind, self.mesh.surface(kind, color, 0.95 * self.richness)

    def window(self, place: Placement, x: float, z: float, size: tuple[float, float], shutters: int | None) -> None:
        """Add a window with frame, bars, sill and, at choice, shutters to the facade at y = 0."""
        w, h = size[0] / 2, size[1]
        frame = self.frame_surfaces[self.rng.integers(2)]
        glass = self.mesh.surface(Kind.GLASS, (0.14, 0.16, 0.18), 1.0)
        self.mesh.box(place, (x - w, -0.02, z), (x + w, 0.0, z + h), glass)
        for low, high in (
            ((x - w - 0.09, z), (x - w, z + h)), ((x + w, z), (x + w + 0.09, z + h)),
            ((x - w - 0.09, z + h), (x + w + 0.09, z + h + 0.1)), ((x - 0.03, z), (x + 0.03, z + h)),
        ):  # fmt: skip
            self.mesh.box(place, (low[0], -0.08, low[1]), (high[0], 0.0, high[1]), frame)
        self.mesh.box(place, (x - w - 0.16, -0.2, z - 0.09), (x + w + 0.16, 0.0, z), frame)
        if shutters is not None:
            for side in (-1, 1):
                middle = x + side * (w + 0.09 + w / 2)
                self.mesh.box(place, (middle - w / 2, -0.06, z), (middle + w / 2, 0.0, z + h), shutters)

    def facade(self, place: Placement, width_m: float, floors: int) -> None:
        """Add door and windows to the facade at y = 0 between x = 0 and the width."""
        columns = max(1, int(width_m / 2.7))
        pitch = width_m / columns
        door = int(self.rng.integers(columns))
        has_shutters = self.rng.random() < 0.6 and pitch > 2.5
        tone = ((0.22, 0.36, 0.27), (0.36, 0.22, 0.14), (0.30, 0.36, 0.46))[self.rng.integers(3)]
        wood = self.mesh.surface(Kind.WOOD, tone, 0.7 * self.richness)
        size = (float(self.rng.uniform(0.9, 1.15)), float(self.rng.uniform(1.3, 1.6)))
        for column in range(columns):
            x = (column + 0.5) * pitch
            for floor in range(floors):
                if floor == 0 and column == door:
                    frame = self.frame_surfaces[0]
                    self.mesh.box(place, (x - 0.65, -0.10, 0.0), (x + 0.65, 0.0, 2.5), frame)
                    self.mesh.box(place, (x - 0.5, -0.12, 0.15), (x + 0.5, 0.0, 2.35), wood)
                    self.mesh.box(place, (x - 0.8, -0.5, 0.0), (x + 0.8, 0.0, 0.15), frame)
                elif self.rng.random() < 0.93:
                    self.window(place, x, 3.1 * floor + 1.0, size, wood if has_shutters else None)
        if self.rng.random() < 0.5 and floors > 1:
            x = (self.rng.integers(columns) + 0.5) * pitch
            self.mesh.box(place, (x - 1.1, -0.9, 3.45), (x + 1.1, 0.0, 3.6), self.frame_surfaces[0])
            for post in np.linspace(-1.07, 1.07, 9):
                self.mesh.box(place, (x + post - 0.02, -0.88, 3.6), (x + post + 0.02, -0.84, 4.5), self.metal)
            self.mesh.box(place, (x - 1.1, -0.9, 4.5), (x + 1.1, -0.82, 4.56), self.metal)

    def house(self, place: Placement, width_m: float, depth_m: float) -> bool:
        """Add a house whose facade runs from the place along x and faces -y, unless something is in the way."""
        corners = np.array([[0, 0, 0], [width_m, 0, 0], [width_m, depth_m, 0], [0, depth_m, 0]], dtype=np.float64)
        footprint = place.to_world(corners)[:, :2]
        shrunk = footprint.mean(axis=0) + 0.98 * (footprint - footprint.mean(axis=0))
        if not self.is_free(shrunk, SIDEWALK_M - 0.25):
            return False
        self.footprints.append(shrunk)
        floors = int(self.rng.integers(2, 4))
        height = 3.1 * floors + float(self.rng.uniform(0.2, 0.9))
        kind, wall = self.wall(height * 2 * (width_m + depth_m))
        self.mesh.box(place, (0.0, 0.0, 0.0), (width_m, depth_m, height), wall)
        if kind is not Kind.PLAIN:
            base = self.mesh.surface(Kind.STONE, self.choose(((0.5, 0.48, 0.45),)), self.richness)
            self.mesh.box(place, (-0.04, -0.05, 0.0), (width_m + 0.04, depth_m, 0.7), base)
        tile = self.mesh.surface(Kind.ROOF, self.choose(((0.55, 0.30, 0.22), (0.48, 0.30, 0.25))), 0.8)
        ridge, eave = height + 0.32 * depth_m, height - 0.12
        for y_eave in (-0.4, depth_m + 0.4):
            slope = [
                (-0.2, y_eave, eave), (width_m + 0.2, y_eave, eave),
                (width_m + 0.2, depth_m / 2, ridge), (-0.2, depth_m / 2, ridge),
            ]  # fmt: skip
            self.mesh.polygon(place, slope, tile)
        for x in (0.0, width_m):
            self.mesh.polygon(place, [(x, 0.0, height), (x, depth_m, height), (x, depth_m / 2, ridge - 0.1)], wall)
        self.mesh.box(place, (-0.05, -0.12, height - 0.35), (width_m + 0.05, 0.0, height - 0.1), self.frame_surfaces[0])
        if kind is Kind.PLAIN or self.rng.random() < 0.93:
            self.facade(place, width_m, floors)
        return True

    def row_of_houses(self, road: Road, side: int) -> None:
        """Line one side of a road with houses."""
        curve = road.axis.shifted_left(side * (road.half_width_m + SIDEWALK_M))
        s, end = 0.0, float(curve.lengths[-1])
        while s < end:
            width, depth = float(self.rng.uniform(7.0, 12.0)), float(self.rng.uniform(8.0, 11.0))
            for shrink in (1.0, 0.7):
                (middle,), (heading,) = curve.at(np.array([s + shrink * width / 2]))
                normal = side * np.array([-np.sin(heading), np.cos(heading)])
                along = heading if side > 0 else heading + np.pi
                setback = float(self.rng.choice([0.0, 0.0, 0.3, 0.6]))
                corner = middle + setback * normal - 0.5 * shrink * width * np.array([np.cos(along), np.sin(along)])
                place = Placement(float(corner[0]), float(corner[1]), float(along), CURB_HEIGHT_M)
                if self.house(place, shrink * width, depth):
                    s += shrink * width + (0.0 if self.rng.random() < 0.65 else float(self.rng.uniform(1.2, 3.0)))
                    break
            else:
                s += 0.5

    def close_end(self, road: Road) -> None:
        """Put houses across both ends of a road, so that the view along it ends at a facade."""
        for index, sign in ((0, -1.0), (-1, 1.0)):
            heading = float(road.axis.headings[index]) + (0.0 if sign > 0 else np.pi)
            ahead = np.array([np.cos(heading), np.sin(heading)])
            left = np.array([-ahead[1], ahead[0]])
            for offset in (0.0, -13.0, 13.0):
                width = 13.0
                corner = (
                    road.axis.points[index]
                    + (road.half_width_m + SIDEWALK_M + 0.5) * ahead
                    + (offset + width / 2) * left
                )
                self.house(
                    Placement(float(corner[0]), float(corner[1]), heading - np.pi / 2, CURB_HEIGHT_M), width, 9.0
                )

    def car(self, place: Placement) -> None:
        """Add a parked car, about 4.2 m by 1.75 m, that points along x."""
        paint = self.mesh.surface(Kind.PAINT, self.choose(_CAR_COLORS), 0.6)
        trim = self.mesh.surface(Kind.PLASTER, (0.16, 0.16, 0.17), 0.6)
        light = self.mesh.surface(Kind.PLASTER, (0.85, 0.85, 0.80), 0.4)
        red = self.mesh.surface(Kind.PLASTER, (0.55, 0.05, 0.05), 0.4)
        hatch = float(self.rng.uniform(0.0, 0.5))
        body = [
            (-2.08, 0.25),
            (2.05, 0.25),
            (2.12, 0.55),
            (1.95, 0.78),
            (0.95, 0.92),
            (-1.7 - hatch / 2, 0.95),
            (-2.1, 0.8),
        ]
        self.mesh.prism(place, body, (0.80, 0.80, 0.85, 0.86, 0.87, 0.87, 0.84), (trim, *([paint] * 6), paint))
        roof = [(-1.75 - hatch / 2, 0.95), (0.95, 0.92), (0.25, 1.42), (-0.6, 1.48), (-1.1 - hatch, 1.43)]
        self.mesh.prism(
            place, roof, (0.84, 0.84, 0.66, 0.66, 0.66), (self.dark, self.dark, paint, paint, self.dark, self.dark)
        )
        for x in (-1.3, 1.28):
            for side in (-1, 1):
                self.mesh.wheel(place, x, side * 0.885, 0.32, self.dark)
                self.mesh.wheel(place, x, side * 0.895, 0.19, self.metal)
        for side in (-1, 1):
            y = side * 0.62
            self.mesh.box(place, (1.9, y - 0.17, 0.55), (2.10, y + 0.17, 0.70), light)
            self.mesh.box(place, (-2.14, y - 0.15, 0.62), (-2.0, y + 0.15, 0.82), red)
            self.mesh.box(
                place, (0.5, min(side * 0.86, side * 1.0), 0.88), (0.68, max(side * 0.86, side * 1.0), 1.02), paint
            )
            for x in (-0.35, -1.2):
                self.mesh.box(
                    place,
                    (x - 0.1, min(side * 0.85, side * 0.9), 0.78),
                    (x + 0.1, max(side * 0.85, side * 0.9), 0.82),
                    trim,
                )
        self.mesh.box(place, (2.05, -0.26, 0.36), (2.15, 0.26, 0.47), light)
        self.mesh.box(place, (-2.13, -0.26, 0.45), (-2.05, 0.26, 0.56), light)

    def tree(self, place: Placement) -> None:
        """Add a street tree."""
        height = float(self.rng.uniform(2.3, 3.0))
        self.mesh.tube(place, 0.12, (0.0, height + 0.5), self.bark)
        leaves = self.mesh.surface(Kind.LEAVES, self.choose(((0.20, 0.34, 0.12), (0.26, 0.36, 0.13))), 1.0)
        self.mesh.ball(place, (0.0, 0.0, height + 1.0), 1.05, leaves)
        for _ in range(3):
            dx, dy, dz = self.rng.uniform(-0.6, 0.6, 3)
            self.mesh.ball(place, (dx, dy, height + 1.2 + dz), float(self.rng.uniform(0.55, 0.8)), leaves)

    def lamp(self, place: Placement) -> None:
        """Add a street lamp whose arm points along x."""
        self.mesh.tube(place, 0.07, (0.0, 5.2), self.metal, 8)
        self.mesh.tube(place, 0.14, (0.0, 0.6), self.metal, 8)
        self.mesh.box(place, (-0.05, -0.04, 5.2), (1.1, 0.04, 5.28), self.metal)
        self.mesh.box(place, (0.6, -0.12, 5.1), (1.2, 0.12, 5.2), self.frame_surfaces[0])

    def street_furniture(self, road: Road) -> None:
        """Park cars and set trees and lamps along a road, clear of the drive."""
        curve = road.axis
        s, end = 3.0, float(curve.lengths[-1])
        while s < end - 3.0:
            (middle,), (heading,) = curve.at(np.array([s]))
            _, (ahead,) = curve.at(np.array([s + 4.0]))
            left = np.array([-np.sin(heading), np.cos(heading)])
            for side in road.house_sides:
                spot = middle + side * _PARKED_OFFSET_M * left
                clear = np.linalg.norm(self.plan.path.points - spot, axis=1).min() > _PATH_CLEARANCE_M
                on_road = -1.6 < self.field.sample(spot[None])[0, 0] < -0.6
                if (
                    road.has_centre_line
                    and abs(ahead - heading) < 0.05
                    and clear
                    and on_road
                    and self.rng.random() < 0.6
                ):
                    jitter = float(self.rng.normal(0, 0.02)) + (np.pi if side > 0 else 0.0)
                    self.car(Placement(float(spot[0]), float(spot[1]), float(heading) + jitter))
                beside = middle + side * (road.half_width_m + 0.55) * left + 2.8 * np.array([left[1], -left[0]])
                stands_free = 0.4 < self.field.sample(beside[None])[0, 0] < 0.8
                if stands_free and self.rng.random() < 0.42:
                    place = Placement(
                        float(beside[0]), float(beside[1]), float(heading) - side * np.pi / 2, CURB_HEIGHT_M
                    )
                    (self.tree if self.rng.random() < 0.5 else self.lamp)(place)
            s += 5.6

    def island(self, x: float, y: float, radius_m: float) -> None:
        """Add a round planter with a column and trees."""
        place = Placement(x, y, 0.3, CURB_HEIGHT_M)
        stone = self.mesh.surface(Kind.STONE, (0.66, 0.62, 0.55), self.richness)
        self.mesh.tube(place, 0.45 * radius_m, (0.0, 0.7), stone, 24)
        self.mesh.tube(place, 0.16 * radius_m, (0.7, 4.0), stone, 16)
        for angle in (0.4, 2.5, 4.6):
            at = 0.72 * radius_m * np.array([np.cos(angle), np.sin(angle)])
            self.tree(Placement(x + float(at[0]), y + float(at[1]), angle, CURB_HEIGHT_M))


def _overlap(first: Floats, second: Floats) -> bool:
    """Whether two convex polygons overlap, by separating axes."""
    for polygon in (first, second):
        edges = np.roll(polygon, -1, axis=0) - polygon
        for normal in np.stack([-edges[:, 1], edges[:, 0]], axis=1):
            a, b = first @ normal, second @ normal
            if a.max() <= b.min() or b.max() <= a.min():
                return False
    return True


def build_town(kind: PathKind, length_m: float, seed: int, richness: float) -> Town:
    """Build the town around a drive.

    Args:
        kind: Shape of the drive.
        length_m: Its length.
        seed: Same seed, same town.
        richness: 1 gives about 18 % of plain wall; 0 three quarters, and no texture on the road.
    """
    plan = plan_roads(kind, length_m)
    field = RoadField(plan, _FIELD_MARGIN_M)
    town = _TownBuilder(plan, field, np.random.default_rng(seed), richness)
    add_ground(town.mesh, field)
    for road in plan.roads:
        if not road.is_closed:
            town.close_end(road)
    for road in plan.roads:
        for side in road.house_sides:
            town.row_of_houses(road, side)
    for road in plan.roads:
        town.street_furniture(road)
    for x, y, radius in plan.islands:
        town.island(x, y, radius)
    return Town(plan, field, town.mesh.build(), town.plain_m2 / town.wall_m2)
