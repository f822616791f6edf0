"""A map of all clusters, like figure 2 of [O]: the grid, the clusters, and how they overlap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from app.clustering.clusters import Clustering
from app.clustering.grid import Cell, GroundGrid, outline
from app.clustering.ground_plan import (
    BLUE,
    INK,
    LIGHT_GREY,
    RED,
    SCALE_BAR_PX,
    WHITE,
    Color,
    GroundPlan,
    Image,
    blank,
    encode_png,
    legend,
    write,
)
from app.clustering.map_labels import MapLabels
from app.scene.posed_scene import PosedScene

_CELL_PX, _PANELS_PX, _MIN_HEIGHT_PX = 8, (760, 1600), 480
"""A panel is as wide as its cells need, within limits."""
_GAP_PX, _HEAD_PX, _FOOT_PX = 14, 46, 46
_TEXT_SCALE = 0.6
_MARGIN = 0.03
_DETAIL_CELL_PX = 211
_MIN_CELL_PX = 4.0
"""Borders of smaller cells would fill the picture."""
_GLASS = 0.55
_NAME_PX = (125, 56)
_DROPPED: Color = (226, 222, 220)
_FILLS: tuple[Color, ...] = (
    (214, 178, 144),
    (148, 198, 245),
    (160, 214, 168),
    (196, 170, 226),
    (150, 224, 232),
    (222, 190, 206),
    (178, 160, 240),
    (204, 214, 150),
)
"""One of them per cluster."""


@dataclass(frozen=True)
class _Area:
    """What the map shows of a cluster."""

    name: str
    cells: tuple[Cell, ...]
    num_views: int
    is_small: bool


def write_map(scene: PosedScene, clustering: Clustering, path: Path, labels: MapLabels) -> None:
    """Draw the grid, the clusters, and a detail where they overlap, beside each other; y is up.

    Clusters that stayed too small have a black cross in each cell.

    Args:
        scene: What was clustered.
        clustering: With at least one cluster.
        path: PNG to write.
        labels: Of the world's axes.
    """
    areas = [_Area(c.name, c.cells, len(c.image_names), c.is_small) for c in clustering.clusters]
    colors = [_FILLS[number] for number in color_numbers([area.cells for area in areas])]
    grid, unit = clustering.grid, labels.unit
    size = np.array(grid.block_size_m)
    dropped = np.array([block.cell for block in clustering.dropped], dtype=np.int64).reshape(-1, 2)
    cells = np.concatenate([dropped, *(np.array(area.cells) for area in areas)])
    low, high = cells.min(axis=0), cells.max(axis=0) + 1
    width = int(np.clip(_CELL_PX * (high - low).max(), *_PANELS_PX))
    height = int(np.clip(width * np.divide(*((high - low) * size)[::-1]), _MIN_HEIGHT_PX, width))
    margin = _MARGIN * (high - low) * size
    corners = low * size + grid.origin_m - margin, high * size + grid.origin_m + margin
    raw = GroundPlan(*corners, (width, height), SCALE_BAR_PX)
    whole = raw.copy()
    raw.boxes(_corners(dropped, grid), _DROPPED)
    _draw_grid(raw, grid, low, high)
    raw.haze(scene.points_in_world, BLUE, 0.4)
    _draw_clusters(whole, scene, areas, colors, grid)
    middle = _middle_of_detail(areas, grid)
    half = np.array([width, height]) / (2 * _DETAIL_CELL_PX) * size.max()
    detail = GroundPlan(middle - half, middle + half, (width, height))
    _draw_detail(detail, scene, areas, colors, grid)
    frame = middle + half * [[-1, -1], [1, -1], [1, 1], [-1, 1]]
    whole.lines(np.stack([frame, np.roll(frame, -1, axis=0)], axis=1), INK, 2)
    columns = (
        (raw, f"Grid of {size[0]:g} x {size[1]:g} {unit}: {len(cells):,} blocks with keypoints"),
        (whole, f"{len(areas):,} clusters of {len(scene.image_names):,} views"),
        (detail, f"Detail: neighbours overlap by {2 * grid.overlap_m:g} {unit}"),
    )
    path.write_bytes(encode_png(_composed(columns, labels)))


def _composed(columns: Sequence[tuple[GroundPlan, str]], labels: MapLabels) -> Image:
    """The panels beside each other with their titles, and the legend below."""
    gap = blank(_GAP_PX, _HEAD_PX + columns[0][0].image.shape[0])
    parts = [gap]
    for plan, title in columns:
        plan.scale_bar(labels, _TEXT_SCALE)
        plan.frame()
        head = blank(plan.image.shape[1], _HEAD_PX)
        write(head, title, (0, 30), 0.75)
        parts += [np.concatenate([head, plan.image]), gap]
    body = np.concatenate(parts, axis=1)
    foot = blank(body.shape[1], _FOOT_PX)
    entries = (
        ("dot", BLUE, "keypoints"),
        ("dot", RED, "views"),
        ("box", _DROPPED, "block left out: too few keypoints, or no view near by"),
        ("box", _lighter(_FILLS[0]), "cluster, in a colour unlike its neighbours'"),
        ("cross", INK, "cluster with few views and no neighbour"),
        ("line", INK, "frame of the detail"),
    )
    legend(foot, (_GAP_PX, 29), entries, _TEXT_SCALE)
    return np.concatenate([body, foot])


def _draw_grid(plan: GroundPlan, grid: GroundGrid, low: NDArray[np.int64], high: NDArray[np.int64]) -> None:
    """All lines of the grid, where they are far enough apart to be seen."""
    size = np.array(grid.block_size_m)
    if size.min() * plan.px_per_unit < _MIN_CELL_PX:
        return
    ends = [((i, low[1]), (i, high[1])) for i in range(low[0], high[0] + 1)]
    ends += [((low[0], j), (high[0], j)) for j in range(low[1], high[1] + 1)]
    plan.lines(np.array(ends) * size + grid.origin_m, LIGHT_GREY)


def _draw_clusters(
    plan: GroundPlan, scene: PosedScene, areas: Sequence[_Area], colors: Sequence[Color], grid: GroundGrid
) -> None:
    """Each cluster in its colour, with a cross if it is small, the keypoints and the views."""
    for area, color in zip(areas, colors, strict=True):
        plan.boxes(_corners(area.cells, grid), _lighter(color))
        if min(grid.block_size_m) * plan.px_per_unit >= _MIN_CELL_PX:
            plan.lines(_sides(area.cells, grid), _darker(color))
    plan.haze(scene.points_in_world, BLUE, 0.25)
    plan.dots(scene.centers_in_world, 1.4, RED)
    for area in areas:
        if area.is_small:
            _cross(plan, area, grid)


def _draw_detail(
    plan: GroundPlan, scene: PosedScene, areas: Sequence[_Area], colors: Sequence[Color], grid: GroundGrid
) -> None:
    """Clusters with their overlap, each as a sheet of coloured glass, with names."""
    overlap = np.array([[-grid.overlap_m], [grid.overlap_m]])
    edges, labels = [], []
    for area, color in zip(areas, colors, strict=True):
        corners = _corners(area.cells, grid)
        if not plan.shows(corners + overlap).any():
            continue
        sheet = plan.copy()
        sheet.image[:] = 0
        sheet.boxes(corners + overlap, WHITE)
        mask = sheet.image[..., 0]
        plan.mix(mask / 255, color, _GLASS)
        edges.append((cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_SIMPLE)[0], _darker(color)))
        corner = _place_for_name(plan.to_pixels(corners - overlap), plan.image.shape)
        if corner is not None:
            labels.append((area, corner))
    plan.dots(scene.points_in_world, 1.0, BLUE, 0.7)
    plan.dots(scene.centers_in_world, 2.0, RED)
    for contours, color in edges:
        cv2.drawContours(plan.image, contours, -1, color, 2, cv2.LINE_AA)
    for area, (x, y) in labels:
        for line, text in enumerate((area.name, f"{area.num_views} views")):
            plan.label(text, (x + 8, y + 22 + 22 * line), 0.55)


def _place_for_name(inner_px: NDArray[np.float64], shape: tuple[int, ...]) -> tuple[int, int] | None:
    """The upper left corner of the first cell that has enough room in the image for a name."""
    for (left, bottom), (right, top) in np.clip(np.round(inner_px), 0, (shape[1], shape[0])).astype(int).tolist():
        if right - left >= _NAME_PX[0] and bottom - top >= _NAME_PX[1]:
            return left, top
    return None


def _middle_of_detail(areas: Sequence[_Area], grid: GroundGrid) -> NDArray[np.float64]:
    """(2,) the middle of the cluster with the most neighbours, and of these of the one with the most views."""
    number_at = {cell: number for number, area in enumerate(areas) for cell in area.cells}

    def num_around(area: _Area) -> int:
        i, j = area.cells[0]
        return sum((i + di, j + dj) in number_at for di in (-1, 0, 1) for dj in (-1, 0, 1))

    best = max(areas, key=lambda area: (num_around(area), area.num_views))
    return grid.center_of(best.cells[0])


def color_numbers(clusters: Sequence[tuple[Cell, ...]]) -> list[int]:
    """A colour for each cluster of cells that the clusters around it don't have, if there are enough."""
    number_at = {cell: number for number, cells in enumerate(clusters) for cell in cells}
    chosen: list[int] = []
    for number, cells in enumerate(clusters):
        around = {number_at.get((i + di, j + dj)) for i, j in cells for di in (-1, 0, 1) for dj in (-1, 0, 1)}
        taken = [chosen[other] for other in around if other is not None and other < number]
        chosen.append(min(range(len(_FILLS)), key=lambda c: (taken.count(c), (c - number) % len(_FILLS))))
    return chosen


def _corners(cells: Sequence[Cell] | NDArray[np.int64], grid: GroundGrid) -> NDArray[np.float64]:
    """(n, 2, 2) lower and upper corner of each cell."""
    low = np.array(cells, dtype=np.float64).reshape(-1, 1, 2) * grid.block_size_m + grid.origin_m
    return np.concatenate([low, low + grid.block_size_m], axis=1)


def _sides(cells: tuple[Cell, ...], grid: GroundGrid) -> NDArray[np.float64]:
    sides: NDArray[np.float64] = outline(cells) * np.array(grid.block_size_m) + grid.origin_m
    return sides


def _cross(plan: GroundPlan, area: _Area, grid: GroundGrid) -> None:
    for low, high in _corners(area.cells, grid):
        a, b = low + 0.3 * (high - low), low + 0.7 * (high - low)
        plan.lines(np.array([[a, b], [(a[0], b[1]), (b[0], a[1])]]), INK, 2)


def _lighter(color: Color) -> Color:
    blue, green, red = (round(0.65 * value + 0.35 * 255) for value in color)
    return blue, green, red


def _darker(color: Color) -> Color:
    blue, green, red = (round(0.62 * value) for value in color)
    return blue, green, red
