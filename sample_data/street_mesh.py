"""Triangles with surface coordinates: boxes, prisms, tubes, balls, and the ground with its curbs."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sample_data.street_texture import Kind, RoadField, Surfaces

Floats = NDArray[np.float64]

CURB_HEIGHT_M = 0.12
_GROUND_CELL_M = 1.0
_GROUND_REACH_M = 250.0
_BOX_CORNERS = np.array([[x, y, z] for z in (0, 1) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))])
_BOX_QUADS = np.array([[0, 1, 5, 4], [2, 3, 7, 6], [3, 0, 4, 7], [1, 2, 6, 5], [4, 5, 6, 7]])
_FANS = np.array([[0, 1, 2], [0, 2, 3]])


@dataclass(frozen=True)
class Placement:
    """Where a local frame stands: x along, y to the left of x, z up."""

    x: float
    y: float
    heading: float
    z: float = 0.0

    def to_world(self, points: Floats) -> Floats:
        """Transform (N, 3) local points."""
        cos, sin = np.cos(self.heading), np.sin(self.heading)
        x, y = points[:, 0], points[:, 1]
        return np.stack([self.x + cos * x - sin * y, self.y + sin * x + cos * y, self.z + points[:, 2]], axis=1)


@dataclass(frozen=True)
class Mesh:
    """Triangles that share no corners, with what is needed to colour them."""

    corners: NDArray[np.float32]
    """(T, 3, 3)."""
    uv_m: NDArray[np.float32]
    """(T, 3, 2) coordinates on the surface in metres."""
    surface: NDArray[np.int32]
    """(T,) row in `surfaces`."""
    surfaces: Surfaces

    def welded(self) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        """Return vertices (V, 3) and triangles (T, 3) with equal corners merged."""
        vertices, index = np.unique(self.corners.reshape(-1, 3), axis=0, return_inverse=True)
        return vertices, index.reshape(-1, 3).astype(np.int32)


@dataclass
class MeshBuilder:
    """Collects triangles."""

    rng: np.random.Generator
    _corners: list[Floats] = field(default_factory=list)
    _uv: list[Floats] = field(default_factory=list)
    _surface: list[NDArray[np.int32]] = field(default_factory=list)
    _rows: list[tuple[float, ...]] = field(default_factory=list)

    def surface(self, kind: Kind, color: tuple[float, float, float], contrast: float) -> int:
        """Add a material; return its row."""
        shift = self.rng.uniform(0.0, 60.0, 2)
        self._rows.append((float(kind), *color, contrast, *shift, float(self.rng.integers(8))))
        return len(self._rows) - 1

    def triangles(self, corners: Floats, uv_m: Floats, surface: int) -> None:
        """Add (T, 3, 3) corners with (T, 3, 2) coordinates on the surface."""
        self._corners.append(corners)
        self._uv.append(uv_m)
        self._surface.append(np.full(len(corners), surface, dtype=np.int32))

    def polygon(self, place: Placement, points: list[tuple[float, float, float]], surface: int) -> None:
        """Add a flat convex polygon; its surface coordinates run along the first edge and across it."""
        local = np.asarray(points, dtype=np.float64)
        edge = local[1] - local[0]
        edge = edge / np.linalg.norm(edge)
        normal = np.cross(edge, local[-1] - local[0])
        across = np.cross(normal / np.linalg.norm(normal), edge)
        uv = np.stack([local @ edge, local @ across], axis=1)
        fan = np.array([[0, i, i + 1] for i in range(1, len(local) - 1)])
        self.triangles(place.to_world(local)[fan], uv[fan], surface)

    def box(
        self, place: Placement, low: tuple[float, float, float], high: tuple[float, float, float], surface: int
    ) -> None:
        """Add a box without its underside; sides have level, upright surface coordinates."""
        corner = np.where(_BOX_CORNERS > 0, high, low)[_BOX_QUADS].reshape(-1, 3)
        x, y, z = corner.reshape(5, 4, 3).transpose(2, 0, 1)
        uv = np.stack([np.stack([x[0], -x[1], -y[2], y[3], x[4]]), np.stack([*z[:4], y[4]])], axis=2)
        quads = place.to_world(corner).reshape(5, 4, 3)
        self.triangles(quads[:, _FANS].reshape(-1, 3, 3), uv[:, _FANS].reshape(-1, 3, 2), surface)

    def prism(
        self,
        place: Placement,
        profile: list[tuple[float, float]],
        half_width_m: tuple[float, ...],
        surfaces: tuple[int, ...],
    ) -> None:
        """Add a body with a closed profile in the x-z plane, seen from its right counter-clockwise.

        Args:
            place: Where it stands.
            profile: Corners (x, z).
            half_width_m: How far the body reaches to each side of its middle at each corner.
            surfaces: Material of each edge (from corner i to i + 1), then that of both sides.
        """
        n = len(profile)
        for i, (x, z) in enumerate(profile):
            x_next, z_next = profile[(i + 1) % n]
            w, w_next = half_width_m[i], half_width_m[(i + 1) % n]
            points = [(x, w, z), (x, -w, z), (x_next, -w_next, z_next), (x_next, w_next, z_next)]
            self.polygon(place, points, surfaces[i])
        for side in (1, -1):
            self.polygon(
                place, [(x, side * w, z) for (x, z), w in zip(profile, half_width_m, strict=True)], surfaces[n]
            )

    def tube(self, place: Placement, radius_m: float, z_m: tuple[float, float], surface: int, sides: int = 10) -> None:
        """Add an upright tube with a lid."""
        angles = np.linspace(0.0, 2 * np.pi, sides + 1)
        ring = [(radius_m * np.cos(a), radius_m * np.sin(a)) for a in angles]
        for (x0, y0), (x1, y1), a0, a1 in zip(ring[:-1], ring[1:], angles[:-1], angles[1:], strict=True):
            local = np.array([(x0, y0, z_m[0]), (x1, y1, z_m[0]), (x1, y1, z_m[1]), (x0, y0, z_m[1])])
            uv = np.array(
                [(a0 * radius_m, z_m[0]), (a1 * radius_m, z_m[0]), (a1 * radius_m, z_m[1]), (a0 * radius_m, z_m[1])]
            )
            fan = np.array([[0, 1, 2], [0, 2, 3]])
            self.triangles(place.to_world(local)[fan], uv[fan], surface)
        self.polygon(place, [(x, y, z_m[1]) for x, y in ring[:-1]], surface)

    def wheel(self, place: Placement, x_m: float, y_m: float, radius_m: float, surface: int) -> None:
        """Add a disc that stands in the x-z plane."""
        angles = np.linspace(0.0, 2 * np.pi, 14)[:-1]
        points = [(x_m + radius_m * np.cos(a), y_m, radius_m + radius_m * np.sin(a)) for a in angles]
        self.polygon(place, points, surface)

    def ball(self, place: Placement, center: tuple[float, float, float], radius_m: float, surface: int) -> None:
        """Add a bumpy ball."""
        n_up, n_around = 9, 14
        bumps = 1 + 0.16 * self.rng.uniform(-1, 1, (n_up, n_around))
        bumps[0], bumps[-1] = 1.0, 1.0
        polar = np.linspace(0.0, np.pi, n_up)[:, None]
        azimuth = np.linspace(0.0, 2 * np.pi, n_around, endpoint=False)[None, :]
        unit = np.stack(
            np.broadcast_arrays(np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)), 2
        )
        grid = unit * (radius_m * bumps)[..., None] + center
        uv = grid[..., :2] + grid[..., 2:] * [0.5, 0.8]
        i, j = (index.ravel() for index in np.meshgrid(range(n_up - 1), range(n_around), indexing="ij"))
        k = (j + 1) % n_around
        quads = [(i, j), (i, k), (i + 1, k), (i + 1, j)]
        corners = place.to_world(np.concatenate([grid[q] for q in quads])).reshape(4, -1, 3).transpose(1, 0, 2)
        plain = np.stack([uv[q] for q in quads], axis=1)
        for fan in ([0, 1, 2], [0, 2, 3]):
            self.triangles(corners[:, fan], plain[:, fan], surface)

    def build(self) -> Mesh:
        """Return all triangles that have an area."""
        corners = np.concatenate(self._corners).astype(np.float32)
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        keep = area > 1e-7
        rows = np.asarray(self._rows, dtype=np.float32)
        surfaces = Surfaces(
            kind=rows[:, 0].astype(np.int8),
            color=rows[:, 1:4].copy(),
            contrast=rows[:, 4].copy(),
            shift_m=rows[:, 5:7].copy(),
            turn=rows[:, 7].astype(np.int8),
        )
        uv = np.concatenate(self._uv).astype(np.float32)
        return Mesh(corners[keep], uv[keep], np.concatenate(self._surface)[keep], surfaces)


def _clip_outside(points: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Cut triangles (T, 3, 2) where the linear function with the given corner values (T, 3) is negative.

    Returns:
        The triangles of the positive part (U, 3, 2), and the edges of the cut (E, 2, 2).
    """
    positive = values > 0
    n_positive = positive.sum(axis=1)
    triangles, edges = [points[n_positive == 3]], []
    for count in (1, 2):
        here = np.flatnonzero(n_positive == count)
        odd = (positive[here] if count == 1 else ~positive[here]).argmax(axis=1)
        order = (odd[:, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(points[here], order[..., None], axis=1).transpose(1, 0, 2)
        fa, fb, fc = np.take_along_axis(values[here], order, axis=1).T
        ab = a + (b - a) * (fa / (fa - fb))[:, None]
        ac = a + (c - a) * (fa / (fa - fc))[:, None]
        if count == 1:
            triangles.append(np.stack([a, ab, ac], axis=1))
        else:
            triangles += [np.stack([ab, b, c], axis=1), np.stack([ab, c, ac], axis=1)]
        edges.append(np.stack([ab, ac], axis=1))
    return np.concatenate(triangles), np.concatenate(edges)


def add_ground(builder: MeshBuilder, roads: RoadField) -> None:
    """Add the road at height 0 and, raised by a curb, everything beyond its edges."""
    surface = builder.surface(Kind.GROUND, (0.4, 0.4, 0.4), 1.0)
    low, high = roads.low, roads.high
    far = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
    flat = np.concatenate([far + _GROUND_REACH_M * np.sign(far - (low + high) / 2), np.zeros((4, 1))], axis=1)[:, :3]
    builder.triangles(flat[[[0, 1, 2], [0, 2, 3]]], flat[[[0, 1, 2], [0, 2, 3]]][..., :2], surface)
    n_x, n_y = ((high - low) / _GROUND_CELL_M).astype(int)
    i, j = (index.ravel() for index in np.meshgrid(range(n_x), range(n_y)))
    steps = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    quads = low + _GROUND_CELL_M * (np.stack([i, j], axis=1)[:, None] + steps)
    points = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    edge = roads.sample(points.reshape(-1, 2))[:, 0].reshape(-1, 3).astype(np.float64)
    raised, cuts = _clip_outside(points, edge)
    top = np.concatenate([raised, np.full((*raised.shape[:2], 1), CURB_HEIGHT_M)], axis=2)
    builder.triangles(top, raised, surface)
    down = np.concatenate([cuts, np.zeros((len(cuts), 2, 1))], axis=2)
    up = down + [0.0, 0.0, CURB_HEIGHT_M]
    quads3 = np.stack([down[:, 0], down[:, 1], up[:, 1], up[:, 0]], axis=1)
    for fan in ([0, 1, 2], [0, 2, 3]):
        builder.triangles(quads3[:, fan], quads3[:, fan][..., :2], surface)
