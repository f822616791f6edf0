"""A picture of a cluster before and after selection, like figure 4 of [O], as SVG: text, quick to write."""

from __future__ import annotations

import re
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from app.clustering.clusters import Cluster
from app.clustering.grid import outline
from app.clustering.map_labels import MapLabels, round_length
from app.occlusion.solid_columns import SolidColumns
from app.view_selection.describe import describe_view, percent
from app.view_selection.explanation import Reason
from app.view_selection.problem import ViewProblem
from app.view_selection.selection import Selection

PANEL_PX = 560
_GAP_PX, _HEAD_PX, _LINE_PX = 12, 92, 22
_FOOT_PX = 46
"""Height at the bottom of a panel that is left to the scale bar."""
_MARGIN = 0.04
_MIN_SPAN = 1e-3
_SUBPIXELS = 10
"""Places in a panel are whole numbers of these."""
_HALF_PX, _SIZE = 5, PANEL_PX * _SUBPIXELS
_RAY_PX = 17

INK, GREY, LIGHT_GREY = "#2c2e32", "#74787d", "#c4c8cd"
BLUE, PADDED, SOLID = "#2870c4", "#e7eff7", "#d0d8de"
NEEDED, NOT_NEEDED = "#c8262c", "#f59632"
_NEEDED_FOR = {Reason.SCARCE, Reason.COVERS, Reason.MATCHES}
_NOT_XML = re.compile("[^\t\n\r -\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def write_picture(
    folder: Path, problem: ViewProblem, cluster: Cluster, selection: Selection, labels: MapLabels
) -> None:
    """Write :func:`draw_selection` to ``CLUSTER.svg`` in a folder, which is made."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{cluster.name}.svg").write_text(draw_selection(problem, cluster, selection, labels), encoding="utf-8")


def draw_selection(problem: ViewProblem, cluster: Cluster, selection: Selection, labels: MapLabels) -> str:
    """Draw a cluster with all of its views beside the same with the selected ones, with titles and legend, as SVG.

    Args:
        problem: The cluster's views and keypoints, and what hides points from views, where selection knows it.
        cluster: Its cells.
        selection: Of its views.
        labels: Of the world's axes.
    """
    lefts = _GAP_PX, 2 * _GAP_PX + PANEL_PX
    below = _HEAD_PX + PANEL_PX + _LINE_PX
    parts = [
        _head(selection, lefts),
        draw_panels(problem, cluster, selection, labels, ((lefts[0], _HEAD_PX), (lefts[1], _HEAD_PX))),
        f'<g transform="translate({_GAP_PX} {below})">{legend(shows_solid=problem.solid is not None)}</g>',
    ]
    if selection.relaxed:
        parts.append(write(f"Relaxed: {'; '.join(selection.relaxed)}", _GAP_PX, below + 2 * _LINE_PX, 13, GREY))
    return document(2 * PANEL_PX + 3 * _GAP_PX, below + (3 if selection.relaxed else 2) * _LINE_PX, "\n".join(parts))


def draw_panels(
    problem: ViewProblem,
    cluster: Cluster,
    selection: Selection,
    labels: MapLabels,
    corners_px: tuple[tuple[int, int], tuple[int, int]],
) -> str:
    """The two maps of :func:`draw_selection` alone, with their upper left corners there.

    Who points at a selected view is told its name and why it was selected.
    """
    plan = _Plan.around(problem, cluster)
    row_of = {name: row for row, name in enumerate(problem.image_names)}
    rows = [row_of[name] for name in selection.image_names]
    centers = plan.places(problem.centers_in_world)
    rays = np.rint(problem.directions_in_world[:, :2] * (1, -1) * _RAY_PX * _SUBPIXELS).astype(np.int64)
    views = np.concatenate([centers, rays], axis=1)
    drawn: dict[str, list[str]] = {NOT_NEEDED: [], NEEDED: []}
    for place, row in enumerate(rows):
        is_needed = not _NEEDED_FOR.isdisjoint(selection.explanation.reasons(place))
        why = f"<title>{_text(f'{selection.image_names[place]}: {describe_view(selection, place)}')}</title>"
        drawn[NEEDED if is_needed else NOT_NEEDED].append(f"<g>{why}{_views(views[row : row + 1])}</g>")
    before = f'<g stroke="{NEEDED}">{_views(views)}</g>'
    after = _dots(np.delete(centers, rows, axis=0), 1.5, LIGHT_GREY)
    after += "".join(f'<g stroke="{color}">{"".join(groups)}</g>' for color, groups in drawn.items())
    name = _text(cluster.name)
    ground = f'<g id="{name}">{_ground(plan, problem, cluster)}</g>'
    marks = _marks(plan, labels)
    panels = "\n".join(
        f'<svg x="{x}" y="{y}" width="{PANEL_PX}" height="{PANEL_PX}" viewBox="0 0 {_SIZE} {_SIZE}" fill="none"'
        f' stroke-width="{_SUBPIXELS}" stroke-linecap="round"><use href="#{name}"/>\n{content}\n{marks}</svg>'
        for (x, y), content in zip(corners_px, (before, after), strict=True)
    )
    return f"<defs>{ground}</defs>\n{panels}"


@dataclass(frozen=True)
class _Plan:
    """Where the ground is in a panel; x is to the right, y is up."""

    middle: NDArray[np.float64]
    px_per_unit: float

    @classmethod
    def around(cls, problem: ViewProblem, cluster: Cluster) -> _Plan:
        """The cells and the views in the middle, as large as fits."""
        boxes = cluster.region().padded_boxes()[:, :, :2]
        shown = np.concatenate([boxes.reshape(-1, 2), problem.centers_in_world[:, :2]])
        low, high = shown.min(axis=0), shown.max(axis=0)
        span = max(float((high - low).max()), _MIN_SPAN) * (1 + 2 * _MARGIN)
        return cls((low + high) / 2, (PANEL_PX - _FOOT_PX) / span)

    def places(self, positions: NDArray[np.float64]) -> NDArray[np.int64]:
        """Places in the panel (..., 2) of positions (..., 2 or more)."""
        offsets = (positions[..., :2] - self.middle) * (self.px_per_unit, -self.px_per_unit)
        return np.rint((offsets + (PANEL_PX / 2, (PANEL_PX - _FOOT_PX) / 2)) * _SUBPIXELS).astype(np.int64)


def _ground(plan: _Plan, problem: ViewProblem, cluster: Cluster) -> str:
    """Cells, keypoints, and what hides points."""
    parts = [_boxes(plan.places(cluster.region().padded_boxes()), PADDED)]
    if problem.solid is not None:
        parts.append(_boxes(plan.places(_solid_boxes(problem.solid, problem.centers_in_world[:, 2])), SOLID))
    # One of those in the same half of a pixel is enough, so that pictures of many keypoints stay small.
    halves = plan.places(problem.keypoints_in_world) // _HALF_PX
    distinct = np.stack(np.divmod(np.unique(halves @ (_SIZE, 1)), _SIZE), axis=1)
    parts.append(f'<g opacity="0.8">{_dots(distinct * _HALF_PX, 1.1, BLUE)}</g>')
    sides = outline(cluster.cells) * np.array(cluster.grid.block_size_m) + cluster.grid.origin_m
    lines = _path("M%d %dL%d %d", plan.places(sides))
    parts.append(f'<path d="{lines}" stroke="{INK}" stroke-width="20" stroke-linecap="butt" stroke-dasharray="90 60"/>')
    return "\n".join(parts)


def _solid_boxes(solid: SolidColumns, heights_of_views: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 2, 2) corners of the columns that are solid above most views, those in a row as one."""
    hides = np.pad(solid.tops_m > np.median(heights_of_views), ((0, 0), (1, 1))).astype(np.int8)
    changes = np.diff(hides, axis=1)
    rows, starts = np.nonzero(changes > 0)
    ends = np.nonzero(changes < 0)[1]
    columns = np.stack([np.stack([rows, starts], axis=1), np.stack([rows + 1, ends], axis=1)], axis=1)
    corners: NDArray[np.float64] = columns * solid.column_m + np.array(solid.corner_m)
    return corners


def _marks(plan: _Plan, labels: MapLabels) -> str:
    """Scale bar, arrow to the north and frame."""
    size, foot = _SIZE, _FOOT_PX * _SUBPIXELS
    length = round_length(0.22 * PANEL_PX / plan.px_per_unit)
    bar = round(length * plan.px_per_unit * _SUBPIXELS)
    y = size - 140
    return (
        f'<g fill="white" fill-opacity="0.85"><path d="M100 {size}v-{foot}h{bar + 160}v{foot}z"/>'
        f'<path d="M{size} {size}v-{foot}h-800v{foot}z"/></g>'
        f'<path d="M180 {y - 50}v50h{bar}v-50" stroke="{INK}" stroke-width="20"/>'
        f'<path d="M{size - 240} {y - 210}l80 240l-80 -60l-80 60z" fill="{INK}"/>'
        f"{write(f'{length:g} {labels.unit}', 180, y - 90, 140)}"
        f"{write(labels.up, size - 480, y + 10, 140)}"
        f'<path d="M0 0h{size}v{size}h-{size}z" stroke="{LIGHT_GREY}" stroke-width="20"/>'
    )


def _head(selection: Selection, lefts: tuple[int, int]) -> str:
    keypoints, samples = selection.explanation.keypoints, selection.explanation.samples
    num_selected = len(selection.image_names)
    num_views = num_selected + sum(map(len, selection.not_selected.values()))
    parts = [write(f"Cluster {selection.cluster}", lefts[0], 28, 20)]
    for left, title, covered in (
        (lefts[0], f"Before: {num_views} views", (keypoints.before, samples.before)),
        (
            lefts[1],
            f"After: {num_selected} views, N_min = {selection.min_views}",
            (keypoints.after, samples.after),
        ),
    ):
        shares = (
            f"{selection.explanation.n_vis} or more see {percent(covered[0], keypoints)} of {keypoints.total:,}"
            f" keypoints and {percent(covered[1], samples)} of {samples.total:,} samples"
        )
        parts += [write(title, left, 60, 16), write(shares, left, 81, 13, GREY)]
    return "\n".join(parts)


def legend(*, shows_solid: bool) -> str:
    """What the symbols mean, in two lines; about as wide as two panels."""
    dot = '<path d="M14 -4h.1" stroke="%s" stroke-width="5.2" stroke-linecap="round"/>'
    ray = '<path d="M4 -4h20" stroke="%s"/><path d="M4 -4h.1" stroke="%s" stroke-width="5.2" stroke-linecap="round"/>'
    box = '<path d="M2 -11h24v14h-24z" fill="%s"/>'
    entries = [
        (0, 0, f'<path d="M1 -4h26" stroke="{INK}" stroke-width="2" stroke-dasharray="9 6"/>', "cells"),
        (0, _LINE_PX, box % PADDED, "overlap"),
        (150, 0, dot % BLUE, "keypoint"),
        (330, 0, ray % (NEEDED, NEEDED), "view (after: needed by a point or a match)"),
        (330, _LINE_PX, ray % (NOT_NEEDED, NOT_NEEDED), "other selected view"),
        (680, 0, dot % LIGHT_GREY, "view not selected"),
    ]
    if shows_solid:
        entries.append((150, _LINE_PX, box % SOLID, "solid above views"))
    return "".join(
        f'<g transform="translate({x} {y})">{symbol}{write(text, 34, 0, 13)}</g>' for x, y, symbol, text in entries
    )


def document(width_px: int, height_px: int, body: str) -> str:
    """A whole SVG file."""
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width_px} {height_px}" width="{width_px}"'
        f' height="{height_px}" font-family="sans-serif">\n'
        f'<rect width="{width_px}" height="{height_px}" fill="white"/>\n{body}\n</svg>\n'
    )


def write(text: str, x: float, y: float, size: float, color: str = INK) -> str:
    """A line of text from its lower left corner."""
    return f'<text x="{x:g}" y="{y:g}" font-size="{size:g}" fill="{color}">{_text(text)}</text>'


def _views(views: NDArray[np.int64]) -> str:
    """Rays, and dots where they begin, of (n, 4) places and directions."""
    dots = _path("M%d %dh1", views[:, :2])
    return f'<path d="{_path("M%d %dl%d %d", views)}"/><path d="{dots}" stroke-width="{5.2 * _SUBPIXELS:g}"/>'


def _dots(places: NDArray[np.int64], radius_px: float, color: str) -> str:
    """Round dots at (n, 2) places."""
    width = 2 * radius_px * _SUBPIXELS
    return f'<path d="{_path("M%d %dh1", places)}" stroke="{color}" stroke-width="{width:g}"/>'


def _boxes(corners: NDArray[np.int64], color: str) -> str:
    """Filled rectangles (n, 2, 2 or more) between opposite corners."""
    (x, y), (x_to, y_to) = corners.transpose(1, 2, 0)
    outlines = _path("M%d %dH%dV%dH%dz", np.stack([x, y, x_to, y_to, x], axis=1))
    return f'<path d="{outlines}" fill="{color}" shape-rendering="crispEdges"/>'


def _path(template: str, rows: NDArray[np.int64]) -> str:
    """A template filled with each row of numbers."""
    return template * len(rows) % tuple(rows.ravel().tolist())


def _text(text: str) -> str:
    """Text as it stands in XML, which has no place for some control characters."""
    return escape(_NOT_XML.sub("?", text))
