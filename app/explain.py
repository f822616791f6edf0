"""Why the views of a workspace's clusters were selected, in words and pictures."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence

from app.errors import InputError
from app.stage import finished_product
from app.view_selection.describe import describe_selection, tabulate_selections
from app.view_selection.selection import Selection, read_selections
from app.workspace import Workspace


def explain(workspace: Workspace, clusters: Sequence[str]) -> Iterable[str]:
    """Explain the selection of some clusters at length, or of all in a table.

    Args:
        workspace: With selected views.
        clusters: Names; none for the table.

    Returns:
        Lines.

    Raises:
        InputError: nothing was selected yet, or a cluster has another name.
    """
    folder = workspace.root / "selection"
    finished_product(folder, "select")
    selections = read_selections(folder)
    if not clusters:
        return tabulate_selections(selections)
    return [describe_selection(selection) for selection in _named(selections, clusters)]


def _named(selections: Iterable[Selection], wanted: Sequence[str]) -> list[Selection]:
    by_name = {selection.cluster: selection for selection in selections}
    for name in wanted:
        if name not in by_name:
            close = difflib.get_close_matches(name, by_name, n=1, cutoff=0)
            raise InputError(f"there is no cluster {name}; did you mean {close[0]}?")
    return [by_name[name] for name in wanted]
