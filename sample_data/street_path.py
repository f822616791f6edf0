"""Where the vehicle drives and where the roads are: plane curves made of lines and arcs.

World: x east, y north, z up, metres. Frame 0 stands at the origin.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

START_HEADING_RAD = 0.15
LANE_OFFSET_M = 1.6
ROAD_HALF_WIDTH_M = 5.2
TURN_RADIUS_M = 9.0
END_MARGIN_M = 26.0
_STEP_M = 0.2


class PathKind(StrEnum):
    """Shape of the drive."""

    STRAIGHT = "straight"
    CORNER = "corner"
    LOOP = "loop"
    ROUNDABOUT = "roundabout"


@dataclass(frozen=True)
class Curve:
    """A sampled plane curve."""

    points: Floats
    """(K, 2), evenly spaced."""
    headings: Floats
    """(K,) direction of travel in radians, counter-clockwise from east, continuous."""
    lengths: Floats
    """(K,) arc length from the start."""

    def at(self, s: Floats) -> tuple[Floats, Floats]:
        """Return positions (N, 2) and headings (N,) at the given arc lengths."""
        xy = np.stack([np.interp(s, self.lengths, self.points[:, axis]) for axis in (0, 1)], axis=1)
        return xy, np.interp(s, self.lengths, self.headings)

    def shifted_left(self, distance_m: float) -> Curve:
        """Return the parallel curve on the left."""
        normals = np.stack([-np.sin(self.headings), np.cos(self.headings)], axis=1)
        points = self.points + distance_m * normals
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        return Curve(points, self.headings, np.concatenate([[0.0], np.cumsum(steps)]))


@dataclass(frozen=True)
class Road:
    """A road's axis and how it looks."""

    axis: Curve
    half_width_m: float = ROAD_HALF_WIDTH_M
    has_centre_line: bool = True
    house_sides: tuple[int, ...] = (1, -1)
    """On which sides houses stand: 1 left, -1 right."""
    is_closed: bool = False


@dataclass(frozen=True)
class RoadPlan:
    """The drive and the roads around it."""

    path: Curve
    """What the vehicle drives, from frame 0 on; long enough for all frames."""
    roads: tuple[Road, ...]
    islands: tuple[tuple[float, float, float], ...] = ()
    """Centres and radii (x, y, r) of what stands inside a ring of road."""


def chain(pieces: Sequence[tuple[float, float]], start: Floats, heading: float) -> Curve:
    """Join lines and arcs smoothly.

    Args:
        pieces: Length in metres and curvature in 1/m (left positive) of each piece.
        start: (2,) first point.
        heading: First direction in radians.
    """
    ends = np.cumsum([length for length, _ in pieces])
    s = np.linspace(0.0, ends[-1], int(ends[-1] / _STEP_M) + 2)
    points, headings = np.empty((len(s), 2)), np.empty(len(s))
    position = np.asarray(start, dtype=np.float64)
    begin = 0.0
    for end, (length, curvature) in zip(ends, pieces, strict=True):
        here = (s >= begin) & (s <= end + 1e-9)
        local = np.append(s[here] - begin, length)
        turned = heading + curvature * local
        if curvature == 0.0:
            offsets = local[:, None] * [math.cos(heading), math.sin(heading)]
        else:
            offsets = (
                np.stack([np.sin(turned) - math.sin(heading), math.cos(heading) - np.cos(turned)], axis=1) / curvature
            )
        points[here], headings[here] = position + offsets[:-1], turned[:-1]
        position, heading, begin = position + offsets[-1], float(turned[-1]), float(end)
    return Curve(points, headings, s)


def _tail(curve: Curve, first_m: float) -> Curve:
    """Cut off the first metres of a curve."""
    keep = curve.lengths >= first_m - 1e-9
    return Curve(curve.points[keep], curve.headings[keep], curve.lengths[keep] - curve.lengths[keep][0])


def _open_plan(pieces: list[tuple[float, float]]) -> RoadPlan:
    """Plan of one road that goes on beyond both ends of the drive."""
    margin = (END_MARGIN_M, 0.0)
    direction = np.array([math.cos(START_HEADING_RAD), math.sin(START_HEADING_RAD)])
    curve = chain([margin, *pieces, margin], -END_MARGIN_M * direction, START_HEADING_RAD)
    return RoadPlan(_tail(curve, END_MARGIN_M), (Road(curve.shifted_left(LANE_OFFSET_M)),))


def _roundabout_plan(length_m: float) -> RoadPlan:
    """Approach from the west, around the island, and out to the north (the third exit).

    The approach is a line at the lane's offset beside the axis through the island's centre; an arc to the right of
    radius r leads onto the ring of radius R. Both are tangent where cos(turn) = (r + offset) / (R + r).
    """
    ring_m, entry_m, ring_half_width_m = 11.0, 10.0, 4.6
    turn = math.acos((entry_m + LANE_OFFSET_M) / (ring_m + entry_m))
    around = math.pi / 2 + 2 * turn
    fixed = 2 * entry_m * turn + ring_m * around
    straight = max(8.0, (length_m - fixed) / 2)
    pieces = [
        (straight, 0.0),
        (entry_m * turn, -1 / entry_m),
        (ring_m * around, 1 / ring_m),
        (entry_m * turn, -1 / entry_m),
        (straight + END_MARGIN_M, 0.0),
    ]
    path = chain(pieces, np.zeros(2), START_HEADING_RAD)
    forward = np.array([math.cos(START_HEADING_RAD), math.sin(START_HEADING_RAD)])
    left = np.array([-forward[1], forward[0]])
    centre = (straight + (entry_m + ring_m) * math.sin(turn)) * forward + LANE_OFFSET_M * left
    ring = chain([(2 * math.pi * ring_m, 1 / ring_m)], centre - ring_m * left, START_HEADING_RAD)
    roads = [Road(ring, ring_half_width_m, has_centre_line=False, house_sides=(-1,), is_closed=True)]
    arm_m = straight + END_MARGIN_M + 8.0
    for quarter in range(4):
        heading = START_HEADING_RAD + quarter * math.pi / 2
        outward = np.array([math.cos(heading), math.sin(heading)])
        roads.append(Road(chain([(arm_m, 0.0)], centre + ring_m * outward, heading), ROAD_HALF_WIDTH_M))
    return RoadPlan(path, tuple(roads), ((float(centre[0]), float(centre[1]), ring_m - ring_half_width_m),))


def plan_roads(kind: PathKind, length_m: float) -> RoadPlan:
    """Lay out the drive and its roads.

    Args:
        kind: Shape of the drive.
        length_m: How far the vehicle drives. A loop closes, with a little overlap, if this suffices for a lap of 156 m.
    """
    quarter = (TURN_RADIUS_M * math.pi / 2, 1 / TURN_RADIUS_M)
    if kind == PathKind.STRAIGHT:
        return _open_plan([(length_m, 0.0)])
    if kind == PathKind.CORNER:
        straight = max(3.0, (length_m - quarter[0]) / 2)
        return _open_plan([(straight, 0.0), quarter, (straight, 0.0)])
    if kind == PathKind.ROUNDABOUT:
        return _roundabout_plan(length_m)
    sides = max(0.93 * length_m, 156.0) - 4 * quarter[0]
    half = sides / 4
    lap = [(half, 0.0), quarter, (sides / 2 - half, 0.0), quarter] * 2
    heading = START_HEADING_RAD
    ring = chain(lap, np.zeros(2), heading)
    path = chain(lap * (1 + math.ceil(length_m / ring.lengths[-1])), np.zeros(2), heading)
    return RoadPlan(path, (Road(ring.shifted_left(LANE_OFFSET_M), is_closed=True),))
