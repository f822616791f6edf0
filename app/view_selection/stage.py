"""The selection stage: clusters -> the views that each of them needs, and a report."""

from __future__ import annotations

import atexit
import json
import logging
import multiprocessing
import os
from collections import Counter, deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from itertools import islice
from pathlib import Path
from typing import Any

from app.child_process import die_with_parent
from app.clustering.clusters import SCENE_FOLDER, Clustering
from app.clustering.map_labels import MapLabels
from app.scene.read_model import open_scene
from app.view_selection.explanation import ExplanationSums
from app.view_selection.options import SelectionOptions
from app.view_selection.picture import write_picture
from app.view_selection.problem import ProblemCutter
from app.view_selection.selection import Selection, select_views, write_selections

logger = logging.getLogger(__name__)

PICTURES_FOLDER = "pictures"

_BATCH, _BATCHES_AHEAD, _MAX_WAITING = 4, 2, 64
"""Clusters solved at a time; batches that each worker process has been given; batches that wait for one before them."""
_MIN_CLUSTERS_PER_WORKER = 64
"""A worker process takes about as long to start as it takes to solve this many clusters."""


def select(
    clusters_dir: Path,
    output_dir: Path,
    *,
    options: SelectionOptions,
    labels: MapLabels | None = None,
    num_workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Select views for every cluster, [O] section 4.

    Args:
        clusters_dir: With ``clusters.jsonl`` and the clustered model.
        output_dir: Gets ``selection.jsonl``, ``report.json`` and ``pictures/CLUSTER.svg``.
        options: The paper's parameters, and the method.
        labels: Of the pictures' axes; by default metres, and y to the north.
        num_workers: Processes; the result doesn't depend on it.
        progress: Called with (clusters done, clusters in all).

    Raises:
        InputError: the clusters can't be read, or don't belong to the model beside them.
    """
    arguments = (clusters_dir, output_dir / PICTURES_FOLDER, options, labels or MapLabels())
    num_clusters = len(Clustering.read(clusters_dir).clusters)
    num_images = len(open_scene(clusters_dir / SCENE_FOLDER).image_names)
    num_workers = max(1, min(num_workers, num_clusters // _MIN_CLUSTERS_PER_WORKER))
    totals = Counter[str]()
    explained = ExplanationSums()
    gaps: dict[str, dict[str, float]] = {}
    empty: list[str] = []

    def counted() -> Iterator[Selection]:
        for done, selection in enumerate(_solved(arguments, num_clusters, num_workers), start=1):
            totals["selected"] += len(selection.image_names)
            totals["relaxed"] += bool(selection.relaxed)
            explained.add(selection.explanation)
            if selection.size_gap > 0 or selection.quality_gap > 0:
                gaps[selection.cluster] = {"size": selection.size_gap, "quality": selection.quality_gap}
            if not selection.image_names:
                empty.append(selection.cluster)
            if progress is not None:
                progress(done, num_clusters)
            yield selection

    output_dir.mkdir(parents=True, exist_ok=True)
    write_selections(counted(), output_dir)
    report: dict[str, Any] = {
        "method": options.method,
        "num_images": num_images,
        "num_clusters": num_clusters,
        "num_images_after_selection": totals["selected"],
        "clusters_per_image": totals["selected"] / num_images,
        "images_per_cluster": totals["selected"] / num_clusters,
        "clusters_with_relaxed_constraints": totals["relaxed"],
        **explained.record(),
        "clusters_not_proven_optimal": gaps,
        "clusters_without_stereo_pair": empty,
    }
    (output_dir / "report.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    logger.info(
        "%d images selected for %d clusters: %.1f images per cluster, %.2f clusters per image",
        totals["selected"],
        num_clusters,
        report["images_per_cluster"],
        report["clusters_per_image"],
    )
    if gaps:
        logger.warning("%d selections are not proven the best: raise selection.max_solver_nodes", len(gaps))
    for name in empty:
        logger.warning("cluster %s has no two views that match: it stays empty", name)


class _Selector:
    """Selects the views of a folder's clusters, and draws some; each process has one of its own."""

    def __init__(self, clusters_dir: Path, pictures_dir: Path, options: SelectionOptions, labels: MapLabels) -> None:
        self._pictures_dir, self._options, self._labels = pictures_dir, options, labels
        self._clusters = Clustering.read(clusters_dir).clusters
        self._cutter = ProblemCutter(open_scene(clusters_dir / SCENE_FOLDER))
        self._drawn = _spread(len(self._clusters), options.max_pictures)

    def select(self, batch: range) -> list[Selection]:
        return [self._select(number) for number in batch]

    def _select(self, number: int) -> Selection:
        cluster = self._clusters[number]
        problem = self._cutter.problem(cluster, self._options.visibility)
        selection = select_views(problem, self._options)
        if number in self._drawn:
            write_picture(self._pictures_dir, problem, cluster, selection, self._labels)
        return selection


def _spread(num_clusters: int, max_chosen: int) -> set[int]:
    """At most so many of the clusters' numbers, evenly spread."""
    count = min(max_chosen, num_clusters)
    return {number * num_clusters // count for number in range(count)}


_selector: _Selector
"""Of a worker process."""


def _start_worker(parent: int, *arguments: Any) -> None:
    global _selector
    die_with_parent(parent)
    # Its results are handed over already. Taking down the libraries that were loaded would take 0.3 s.
    atexit.register(os._exit, 0)
    _selector = _Selector(*arguments)


def _select_in_worker(batch: range) -> list[Selection]:
    return _selector.select(batch)


def _solved(arguments: tuple[Any, ...], num_clusters: int, num_workers: int) -> Iterator[Selection]:
    """Selections in the order of the clusters, with few of them in memory; this process is one of the workers."""
    batches = iter([range(first, min(first + _BATCH, num_clusters)) for first in range(0, num_clusters, _BATCH)])
    solved = deque[Future[list[Selection]]]()
    if num_workers == 1:
        selector = _Selector(*arguments)
        for batch in batches:
            yield from selector.select(batch)
        return
    with ProcessPoolExecutor(
        num_workers - 1,
        multiprocessing.get_context("spawn"),
        initializer=_start_worker,
        initargs=(os.getpid(), *arguments),
    ) as executor:

        def hand_out() -> None:
            under_way = sum(not batch.done() for batch in solved)
            for batch in islice(batches, _BATCHES_AHEAD * (num_workers - 1) - under_way):
                solved.append(executor.submit(_select_in_worker, batch))

        hand_out()
        selector = _Selector(*arguments)
        while True:
            own = next(batches, None) if len(solved) < _MAX_WAITING * num_workers else None
            if own is not None:
                solved.append(Future())
                solved[-1].set_result(selector.select(own))
            hand_out()
            if not solved:
                return
            while solved and (own is None or solved[0].done()):
                yield from solved.popleft().result()
