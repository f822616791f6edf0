"""A district: streets on a grid, houses between them, and a route that takes some streets several times.

house | house | house       Streets have houses on both sides, parks here and there, and nothing but a
------o-------o------       fence along the southern edge. Where two boulevards cross, the crossing is
house | house | house       a roundabout. Right-hand traffic.
------o-------o------
 (open country)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

LANE_OFFSET_M = 2.0
_BOULEVARD_HALF_WIDTH_M = 14.0
_ROUNDABOUT_RADIUS_M = 9.0
_OUTER_HOUSE_DEPTH_M = 40.0
_PATH_STEP_M = 0.25
_TURN_SMOOTHING_M = 7.0

Node = tuple[int, int]
Street = tuple[Node, Node]


@dataclass(frozen=True, kw_only=True)
class District:
    """Streets along the lines x = ``lines_m[0][i]`` and y = ``lines_m[1][j]``, in the district's own frame."""

    lines_m: tuple[NDArray[np.float64], NDArray[np.float64]]
    half_widths_m: tuple[NDArray[np.float64], NDArray[np.float64]]
    """From the middle of a street to its facades."""
    roundabout: Node
    is_house: NDArray[np.bool_]
    """(I + 1, J + 1) block (i, j) lies between the streets i - 1 and i, j - 1 and j; the others are open ground."""

    def bounds_of(self, axis: int, block: int) -> tuple[float, float]:
        """Where a block begins and ends along one axis."""
        lines, widths = self.lines_m[axis], self.half_widths_m[axis]
        low = lines[block - 1] + widths[block - 1] if block > 0 else lines[0] - widths[0] - _OUTER_HOUSE_DEPTH_M
        high = lines[block] - widths[block] if block < len(lines) else lines[-1] + widths[-1] + _OUTER_HOUSE_DEPTH_M
        return float(low), float(high)

    def houses(self) -> NDArray[np.float64]:
        """(H, 4) x and y of the lower corner, x and y of the upper one."""
        corners = [(self.bounds_of(0, i), self.bounds_of(1, j)) for i, j in np.argwhere(self.is_house).tolist()]
        return np.array([(x[0], y[0], x[1], y[1]) for x, y in corners])


def make_district(num_streets: int, street_spacing_m: float, house_share: float, rng: np.random.Generator) -> District:
    """A grid of streets about ``street_spacing_m`` apart."""
    lines, widths = [], []
    roundabout = (num_streets // 2, num_streets // 2)
    for axis in range(2):
        lines.append(np.cumsum(street_spacing_m * rng.uniform(0.75, 1.25, num_streets)))
        half_widths = rng.uniform(7.5, 10.5, num_streets)
        half_widths[roundabout[axis]] = _BOULEVARD_HALF_WIDTH_M
        widths.append(half_widths)
    is_house = rng.random((num_streets + 1, num_streets + 1)) < house_share
    is_house[:, 0] = False
    return District(
        lines_m=(lines[0], lines[1]), half_widths_m=(widths[0], widths[1]), roundabout=roundabout, is_house=is_house
    )


def drive_route(district: District, length_m: float, rng: np.random.Generator) -> list[Node]:
    """Crossings on the way, without turning back; seldom driven streets attract."""
    lines = district.lines_m
    visits: dict[Street, int] = {}
    route = [(0, 0), (1, 0)]
    driven = 0.0
    while driven < length_m + 100.0:
        (i, j), before = route[-1], route[-2]
        nearby = [(i - 1, j), (i, j - 1), (i, j + 1), (i + 1, j)]
        onward = [
            node for node in nearby if node != before and 0 <= node[0] < len(lines[0]) and 0 <= node[1] < len(lines[1])
        ]
        weights = np.array([(1.0 + visits.get(street(route[-1], node), 0)) ** -3.0 for node in onward])
        node = onward[rng.choice(len(onward), p=weights / weights.sum())]
        visits[street(route[-1], node)] = visits.get(street(route[-1], node), 0) + 1
        driven += abs(lines[0][node[0]] - lines[0][i]) + abs(lines[1][node[1]] - lines[1][j])
        route.append(node)
    return route


def street(a: Node, b: Node) -> Street:
    """The street between two crossings, whichever way it is driven."""
    return (a, b) if a < b else (b, a)


def path_of(district: District, route: list[Node]) -> NDArray[np.float64]:
    """(n, 2) positions every 0.25 m on the right lane, round in turns and roundabouts."""
    centers = np.array([[district.lines_m[0][i], district.lines_m[1][j]] for i, j in route])
    ahead = np.sign(np.diff(centers, axis=0))
    right = LANE_OFFSET_M * np.stack([ahead[:, 1], -ahead[:, 0]], axis=1)
    corners = [centers[:1] + right[:1]]
    for k in range(1, len(route) - 1):
        if route[k] == district.roundabout:
            corners.append(centers[k] + _round(ahead[k - 1], ahead[k]))
        elif np.array_equal(ahead[k - 1], ahead[k]):
            corners.append(centers[k : k + 1] + right[k])
        else:
            corners.append(centers[k : k + 1] + right[k - 1] + right[k])
    polyline = np.concatenate([*corners, centers[-1:] + right[-1:]])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(polyline, axis=0), axis=1))])
    steps = np.arange(0.0, along[-1], _PATH_STEP_M)
    path = np.stack([np.interp(steps, along, polyline[:, axis]) for axis in range(2)], axis=1)
    window = np.full(round(_TURN_SMOOTHING_M / _PATH_STEP_M), _PATH_STEP_M / _TURN_SMOOTHING_M)
    return np.stack([np.convolve(path[:, axis], window / window.sum(), mode="valid") for axis in range(2)], axis=1)


def _round(arriving: NDArray[np.float64], leaving: NDArray[np.float64]) -> NDArray[np.float64]:
    """Corners of a way around a roundabout, counterclockwise, relative to its centre."""
    first = np.arctan2(-arriving[1], -arriving[0]) + 0.5
    last = np.arctan2(leaving[1], leaving[0]) - 0.5
    turn = (last - first) % (2 * np.pi)
    angles = first + np.linspace(0.0, turn, max(2, round(turn / 0.2)))
    return _ROUNDABOUT_RADIUS_M * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def ground_height(positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n,) heights of gentle hills at (n, 2) positions."""
    heights: NDArray[np.float64] = 2.0 * np.sin(positions[:, 0] / 90.0) + 1.5 * np.sin(positions[:, 1] / 70.0)
    return heights
