"""Why the views of a workspace's clusters were selected, in words and pictures."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from app.clustering.clusters import Cluster, Clustering
from app.errors import InputError
from app.scene.read_model import open_scene
from app.stage import finished_record
from app.stages import map_labels
from app.view_selection.describe import describe_selection, tabulate_selections
from app.view_selection.options import Visibility
from app.view_selection.picture import write_picture
from app.view_selection.problem import ProblemCutter
from app.view_selection.selection import Selection, read_selections
from app.view_selection.stage import PICTURES_FOLDER
from app.workspace import Workspace


def explain(workspace: Workspace, names: Sequence[str], *, draw_all: bool = False) -> Iterator[str]:
    """Explain the selection of some clusters at length and draw them, or tabulate all.

    Args:
        workspace: With selected views. Pictures go to ``selection/pictures/CLUSTER.svg``.
        names: Of clusters; none for the table.
        draw_all: Draw every cluster of the table.

    Yields:
        Lines.

    Raises:
        InputError: nothing was selected yet, or a cluster has another name.
    """
    folder = workspace.root / "selection"
    visibility = Visibility(finished_record(folder, "select").options["visibility"])
    clusters = Clustering.read(workspace.root / "clusters").clusters
    if not names:
        yield from tabulate_selections(read_selections(folder))
        if draw_all:
            yield _draw(workspace, zip(clusters, read_selections(folder), strict=True), visibility)
        return
    numbers, selections = _named(folder, names)
    where = _draw(workspace, ((clusters[numbers[name]], selections[name]) for name in names), visibility)
    yield from (describe_selection(selections[name]) for name in names)
    yield where


def _named(folder: Path, names: Sequence[str]) -> tuple[dict[str, int], dict[str, Selection]]:
    """Number of each cluster, and the selections of the named ones."""
    numbers, selections = {}, {}
    for number, selection in enumerate(read_selections(folder)):
        numbers[selection.cluster] = number
        if selection.cluster in names:
            selections[selection.cluster] = selection
    for name in names:
        if name not in selections:
            close = difflib.get_close_matches(name, numbers, n=1, cutoff=0)
            raise InputError(f"there is no cluster {name}; did you mean {close[0]}?")
    return numbers, selections


def _draw(workspace: Workspace, found: Iterable[tuple[Cluster, Selection]], visibility: Visibility) -> str:
    folder, labels = workspace.root / "selection" / PICTURES_FOLDER, map_labels(workspace)
    cutter = ProblemCutter(open_scene(workspace.scene))
    for cluster, selection in found:
        write_picture(folder, cutter.problem(cluster, visibility), cluster, selection, labels)
    return f"pictures: {folder}"
