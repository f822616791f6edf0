"""Figures 2 and 4 of [O] for any model: the map of its clusters, and some of them before and after selection.

    python -m benchmarks.clustering_figures MODEL OUT_DIR CLUSTER...

Writes `clusters.png` and `selection.svg`. Without names of clusters it prints all, with their numbers of views and
keypoints and with how many views stand in the cells, to choose from; and what pictures and explanations cost, of every
cluster.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import numpy as np

from app.clustering.clusters import SCENE_FOLDER, Cluster, Clustering
from app.clustering.ground_plan import encode_png
from app.clustering.map_labels import MapLabels
from app.clustering.map_picture import write_map
from app.clustering.options import ClusteringOptions
from app.clustering.stage import cluster
from app.scene.posed_scene import PosedScene
from app.scene.read_model import open_scene
from app.view_selection import selection
from app.view_selection.options import SelectionOptions
from app.view_selection.picture import PANEL_PX, document, draw_panels, draw_selection, legend, write
from app.view_selection.problem import ProblemCutter
from benchmarks.machine import describe_machine

GAP_PX, TITLE_PX = 12, 40
TITLE_SIZE_PX, LEGEND_SCALE, LEGEND_PX = 22, 1.6, 90
COMPRESSION = 9


def main() -> None:
    """Cluster, select, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path, help="COLMAP model, z up, in metres")
    parser.add_argument("out", type=Path, help="folder for the pictures")
    parser.add_argument("clusters", nargs="*", help="names, from left to right")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        clustering = cluster(arguments.model, Path(scratch), options=ClusteringOptions())
        scene = open_scene(Path(scratch) / SCENE_FOLDER)
        if not arguments.clusters:
            for found in clustering.clusters:
                print(found.name, len(found.image_names), found.num_keypoints, num_inside(scene, found))
            print_costs(scene, clustering, Path(scratch) / "map.png")
            return
        arguments.out.mkdir(parents=True, exist_ok=True)
        # In 32 levels of each colour: nobody sees the difference, and a quarter fewer bytes.
        small = encode_png(cv2.imread(str(Path(scratch) / "map.png")) | 7, COMPRESSION)
        (arguments.out / "clusters.png").write_bytes(small)
        by_name = {found.name: found for found in clustering.clusters if found.name in arguments.clusters}
        chosen = [by_name[name] for name in arguments.clusters]
        (arguments.out / "selection.svg").write_text(figure(scene, chosen), encoding="utf-8")


def num_inside(scene: PosedScene, found: Cluster) -> int:
    """How many of a cluster's views stand in its cells."""
    rows = scene.image_names.rows_of(found.image_names)
    return int(found.region().contains(scene.centers_in_world[rows]).sum())


def print_costs(scene: PosedScene, clustering: Clustering, map_file: Path) -> None:
    """Median CPU-ms per cluster of explaining the selection and of drawing it, and CPU-s of the map."""
    cutter, options = ProblemCutter(scene), SelectionOptions()
    costs: dict[str, list[float]] = {"select": [], "explain": [], "draw": []}

    def timed(name: str, work: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **keywords: Any) -> Any:
            started = time.process_time()
            made = work(*arguments, **keywords)
            costs[name].append(time.process_time() - started)
            return made

        return call

    sizes = []
    with mock.patch.object(selection, "explain_selection", timed("explain", selection.explain_selection)):
        for found in clustering.clusters:
            problem = cutter.problem(found, options.visibility)
            selected = timed("select", selection.select_views)(problem, options)
            picture = timed("draw", draw_selection)(problem, found, selected, MapLabels())
            sizes.append(len(picture) / 1000)
    started = time.process_time()
    write_map(scene, clustering, map_file, MapLabels())
    print(describe_machine())
    medians = ", ".join(f"{name} {1000 * np.median(values):.1f} ms" for name, values in costs.items())
    print(f"{len(sizes)} clusters, medians: {medians}, {np.median(sizes):.0f} kB a picture")
    print(f"map: {time.process_time() - started:.2f} s, {map_file.stat().st_size / 1000:.0f} kB")


def figure(scene: PosedScene, clusters: list[Cluster]) -> str:
    """One column per cluster, before above after."""
    cutter, options = ProblemCutter(scene), SelectionOptions()
    before, after = TITLE_PX, 2 * TITLE_PX + PANEL_PX
    parts = []
    for column, found in enumerate(clusters):
        problem = cutter.problem(found, options.visibility)
        selected = selection.select_views(problem, options)
        x = column * (PANEL_PX + GAP_PX)
        parts += [
            write(f"{found.name}: {len(found.image_names)} views", x, before - GAP_PX, TITLE_SIZE_PX),
            write(f"{len(selected.image_names)} of them selected", x, after - GAP_PX, TITLE_SIZE_PX),
            draw_panels(problem, found, selected, MapLabels(), ((x, before), (x, after))),
        ]
    bottom = after + PANEL_PX
    symbols = legend(shows_solid=False)
    parts.append(f'<g transform="translate(0 {bottom + LEGEND_PX // 3}) scale({LEGEND_SCALE})">{symbols}</g>')
    return document(len(clusters) * (PANEL_PX + GAP_PX) - GAP_PX, bottom + LEGEND_PX, "\n".join(parts))


if __name__ == "__main__":
    main()
