"""The selection stage: clusters -> the views that each of them needs, and a report."""

from __future__ import annotations

import json
import logging
import multiprocessing
import os
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from itertools import islice
from pathlib import Path
from typing import Any

from app.clustering.clusters import Clustering
from app.executor import die_with_parent
from app.scene.read_model import read_posed_scene
from app.view_selection.explanation import ExplanationSums
from app.view_selection.options import SelectionOptions
from app.view_selection.problem import ProblemCutter, ViewProblem
from app.view_selection.selection import Selection, select_views, write_selections

logger = logging.getLogger(__name__)

_MIN_CLUSTERS_PER_WORKER = 16
"""A worker process takes about as long to start as it takes to solve this many clusters."""


def select(
    model_dir: Path,
    clusters_dir: Path,
    output_dir: Path,
    *,
    options: SelectionOptions,
    num_workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Select views for every cluster, [O] section 4.

    Args:
        model_dir: The COLMAP model that was clustered.
        clusters_dir: With ``clusters.jsonl``.
        output_dir: Gets ``selection.jsonl`` and ``report.json``.
        options: The paper's parameters, and the method.
        num_workers: Processes; the result doesn't depend on it.
        progress: Called with (clusters done, clusters in all).

    Raises:
        InputError: the model or the clusters can't be read, or don't belong together.
    """
    clustering = Clustering.read(clusters_dir)
    scene = read_posed_scene(model_dir)
    cutter = ProblemCutter(scene, clustering.grid)
    problems = (cutter.problem(cluster) for cluster in clustering.clusters)
    num_clusters = len(clustering.clusters)
    num_workers = max(1, min(num_workers, num_clusters // _MIN_CLUSTERS_PER_WORKER))
    totals = Counter[str]()
    explained = ExplanationSums()
    gaps: dict[str, dict[str, float]] = {}
    empty: list[str] = []

    def counted() -> Iterator[Selection]:
        for done, selection in enumerate(_solved(problems, options, num_workers), start=1):
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
        "num_images": len(scene.image_names),
        "num_clusters": num_clusters,
        "num_images_after_selection": totals["selected"],
        "clusters_per_image": totals["selected"] / len(scene.image_names),
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


def _solved(problems: Iterable[ViewProblem], options: SelectionOptions, num_workers: int) -> Iterator[Selection]:
    """Selections in the order of the problems, with few of either in memory."""
    if num_workers == 1:
        yield from (select_views(problem, options) for problem in problems)
        return
    with ProcessPoolExecutor(
        num_workers, multiprocessing.get_context("spawn"), initializer=die_with_parent, initargs=(os.getpid(),)
    ) as executor:
        problems = iter(problems)
        running = deque[Future[Selection]]()
        for problem in islice(problems, 2 * num_workers):
            running.append(executor.submit(select_views, problem, options))
        while running:
            yield running.popleft().result()
            for problem in islice(problems, 1):
                running.append(executor.submit(select_views, problem, options))
