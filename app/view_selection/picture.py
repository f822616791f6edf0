"""A picture of a cluster before and after selection, like figure 4 of [O]."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from app.clustering.clusters import Cluster
from app.clustering.ground_plan import (
    BLUE,
    GREY,
    INK,
    LIGHT_GREY,
    RED,
    SCALE_BAR_PX,
    Color,
    GroundPlan,
    Image,
    MapLabels,
    blank,
    encode_png,
    legend,
    outline,
    write,
)
from app.view_selection.describe import percent
from app.view_selection.explanation import Reason
from app.view_selection.problem import ViewProblem
from app.view_selection.selection import Selection

_PANEL_PX, _GAP_PX, _HEAD_PX, _LINE_PX = 560, 12, 92, 22
_MARGIN = 0.04
_MIN_SPAN = 1e-3
_RAY_PX = 17.0
_PADDED: Color = (247, 239, 231)
SOLID: Color = (222, 216, 208)
NOT_NEEDED: Color = (50, 150, 245)
_NEEDED = {Reason.SCARCE, Reason.COVERS, Reason.MATCHES}


def write_picture(
    folder: Path, problem: ViewProblem, cluster: Cluster, selection: Selection, labels: MapLabels
) -> None:
    """Write :func:`draw_selection` to ``CLUSTER.png`` in a folder, which is made."""
    folder.mkdir(parents=True, exist_ok=True)
    picture = encode_png(draw_selection(problem, cluster, selection, labels))
    (folder / f"{cluster.name}.png").write_bytes(picture)


def draw_selection(problem: ViewProblem, cluster: Cluster, selection: Selection, labels: MapLabels) -> Image:
    """Draw a cluster with all of its views beside the same with the selected ones, with title and legend.

    Args:
        problem: The cluster's views and keypoints, and what hides points from views, where selection knows it.
        cluster: Its cells.
        selection: Of its views.
        labels: Of the world's axes.

    Returns:
        (H, W, 3)
    """
    before, after = draw_panels(problem, cluster, selection, labels)
    gap = blank(_GAP_PX, _PANEL_PX)
    body = np.concatenate([gap, before, gap, after, gap], axis=1)
    symbols = legend_of_panels(body.shape[1], shows_solid=problem.solid is not None)
    return np.concatenate([_head(selection, body.shape[1]), body, symbols, _foot(selection, body.shape[1])])


def draw_panels(problem: ViewProblem, cluster: Cluster, selection: Selection, labels: MapLabels) -> tuple[Image, Image]:
    """The two maps of :func:`draw_selection` alone."""
    selected = np.isin(problem.image_names, selection.image_names)
    needed = np.zeros(len(selected), dtype=np.bool_)
    places = range(len(selection.image_names))
    needed[selected] = [not _NEEDED.isdisjoint(selection.explanation.reasons(place)) for place in places]
    before = _ground(problem, cluster)
    after = before.copy()
    _draw_views(before, problem, np.ones_like(selected), RED)
    after.dots(problem.centers_in_world[~selected], 1.5, LIGHT_GREY)
    _draw_views(after, problem, selected & ~needed, NOT_NEEDED)
    _draw_views(after, problem, needed, RED)
    for plan in (before, after):
        plan.scale_bar(labels)
        plan.frame()
    return before.image, after.image


def _ground(problem: ViewProblem, cluster: Cluster) -> GroundPlan:
    """Cells and keypoints, in a square around them and the views."""
    boxes = cluster.region().padded_boxes()[:, :, :2]
    shown = np.concatenate([boxes.reshape(-1, 2), problem.centers_in_world[:, :2]])
    low, high = shown.min(axis=0), shown.max(axis=0)
    half = max(float((high - low).max()) / 2, _MIN_SPAN) * (1 + 2 * _MARGIN)
    plan = GroundPlan((low + high) / 2 - half, (low + high) / 2 + half, (_PANEL_PX, _PANEL_PX), SCALE_BAR_PX)
    plan.boxes(boxes, _PADDED)
    if problem.solid is not None:
        hides = problem.solid.tops_m > np.median(problem.centers_in_world[:, 2])
        lower = np.argwhere(hides) * problem.solid.column_m + problem.solid.corner_m
        plan.boxes(np.stack([lower, lower + problem.solid.column_m], axis=1), SOLID)
    plan.dots(problem.keypoints_in_world, 1.1, BLUE, 0.8)
    sides = outline(cluster.cells) * np.array(cluster.grid.block_size_m) + cluster.grid.origin_m
    plan.dashed_lines(sides, INK, 2)
    return plan


def _draw_views(plan: GroundPlan, problem: ViewProblem, chosen: NDArray[np.bool_], color: Color) -> None:
    plan.rays(problem.centers_in_world[chosen], problem.directions_in_world[chosen], _RAY_PX, color)
    plan.dots(problem.centers_in_world[chosen], 2.6, color)


def _head(selection: Selection, width: int) -> Image:
    bar = blank(width, _HEAD_PX)
    write(bar, f"Cluster {selection.cluster}", (_GAP_PX, 28), 0.7)
    keypoints, samples = selection.explanation.keypoints, selection.explanation.samples
    num_selected = len(selection.image_names)
    num_views = num_selected + sum(map(len, selection.not_selected.values()))
    for left, title, covered in (
        (_GAP_PX, f"Before: {num_views} views", (keypoints.before, samples.before)),
        (
            2 * _GAP_PX + _PANEL_PX,
            f"After: {num_selected} views, N_min = {selection.min_views}",
            (keypoints.after, samples.after),
        ),
    ):
        write(bar, title, (left, 60), 0.55)
        shares = (
            f"{selection.explanation.n_vis} or more see {percent(covered[0], keypoints)} of {keypoints.total:,}"
            f" keypoints and {percent(covered[1], samples)} of {samples.total:,} samples"
        )
        write(bar, shares, (left, 81), 0.42, GREY)
    return bar


def _foot(selection: Selection, width: int) -> Image:
    bar = blank(width, _LINE_PX if selection.relaxed else 0)
    if selection.relaxed:
        write(bar, f"Relaxed: {'; '.join(selection.relaxed)}", (_GAP_PX, 14), 0.42, GREY)
    return bar


@cache
def legend_of_panels(width: int, *, shows_solid: bool = False, text_scale: float = 0.42) -> Image:
    """What the symbols mean."""
    bar = blank(width, 3 * _LINE_PX // 2)
    entries = [
        ("dash", INK, "cells"),
        ("box", _PADDED, "overlap"),
        ("dot", BLUE, "keypoint"),
        ("ray", RED, "view (after: needed by a point or a match)"),
        ("ray", NOT_NEEDED, "other selected view"),
        ("dot", LIGHT_GREY, "view not selected"),
    ]
    if shows_solid:
        entries.append(("box", SOLID, "solid above views"))
    legend(bar, (_GAP_PX, _LINE_PX), entries, text_scale)
    return bar
