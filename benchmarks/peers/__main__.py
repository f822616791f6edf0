"""Time and quality of the program and of other methods against the number of images, and a figure of the times.

python -m benchmarks.peers OUTPUT.json FIGURE.svg [--limit-s 3600] [--images 250 500 1000 2000 4000 8000 12000]
                           [--models MODEL ...] [--methods METHOD ...] [--jobs 1] [--scaling SCALING.json]

The drives are like seq5, one for each number of images; ``--models`` names larger ones beside them. A method isn't
tried on more images once it has taken more than the limit, in CPU-seconds. As many methods as ``--jobs`` work side by
side. ``--scaling`` adds the program's times on more images from `benchmarks.scaling` to the figure.

Coverage: keypoints that at least two images of one cluster see, projecting into them from within 38 m. Matchability:
images of a cluster that see 20 common keypoints with at least two others of it. Both on every fourth keypoint.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import KDTree

from app.clustering.options import ClusteringOptions
from app.scene.posed_scene import PosedScene
from app.scene.read_model import open_scene, store_scene
from app.view_selection.options import SelectionOptions
from benchmarks.drives.presets import PRESETS
from benchmarks.drives.vehicle import CAMERAS
from benchmarks.drives.write_drive import write_drive
from benchmarks.log_chart import write_log_chart
from benchmarks.machine import describe_machine
from benchmarks.peers.run_one import METHODS, OURS, Clusters, run_method
from benchmarks.reference.clustering import sees

_EVERY_KEYPOINT = 4
_DRIVE = PRESETS["seq5"]


@dataclass(frozen=True, kw_only=True)
class _Town:
    """A model of a simulated drive."""

    model_dir: Path
    scene: PosedScene
    tree: KDTree
    """Every fourth keypoint's position on the ground."""


@dataclass(frozen=True, kw_only=True)
class _Row:
    """One method on one town; all but the time are None where it took more than the limit."""

    num_images: int
    method: str
    cpu_s: float
    num_clusters: int | None = None
    views_per_cluster: float | None = None
    coverage: float | None = None
    matchability: float | None = None

    def __str__(self) -> str:
        """A row of the table."""
        if self.num_clusters is None:
            return f"| {self.num_images:,} | {self.method} | over {self.cpu_s:,.0f} | | | | |"
        return (
            f"| {self.num_images:,} | {self.method} | {self.cpu_s:,.1f} | {self.num_clusters:,} "
            f"| {self.views_per_cluster:.1f} | {self.coverage:.1%} | {self.matchability:.1%} |"
        )


def main() -> None:
    """Print a row per method and number of images; write them and the figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path)
    parser.add_argument("figure", type=Path)
    parser.add_argument("--limit-s", type=int, default=3600)
    parser.add_argument("--images", type=int, nargs="+", default=[250, 500, 1000, 2000, 4000, 8000, 12000])
    parser.add_argument("--models", type=Path, nargs="*", default=[], help="COLMAP models, small to large")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=METHODS)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--scaling", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=arguments.output.parent) as scratch:
        drives = [_write_drive(wanted, Path(scratch) / str(wanted)) for wanted in sorted(arguments.images)]
        models = (*drives, *arguments.models)
        towns = [_town(model_dir, Path(scratch) / f"scene{number}") for number, model_dir in enumerate(models)]
        with ThreadPoolExecutor(arguments.jobs) as pool:
            found = pool.map(lambda method: _run_method(method, towns, arguments.limit_s), arguments.methods)
            rows = sorted(itertools.chain(*found), key=lambda row: (row.num_images, METHODS.index(row.method)))
    arguments.output.write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n")
    print(describe_machine())
    print(f"{_DRIVE}; limit {arguments.limit_s} CPU-s; {arguments.jobs} methods side by side")
    print("| images | method | CPU-s | clusters | views per cluster | coverage | matchability |")
    print("|---|---|---|---|---|---|---|")
    for row in rows:
        print(row)
    _write_figure(arguments.figure, rows, arguments.scaling)


def _run_method(method: str, towns: list[_Town], limit_s: int) -> list[_Row]:
    """On ever larger towns, until it takes more than the limit; each row is shown as it comes."""
    rows: list[_Row] = []
    for town in towns:
        rows.append(_row(method, town, limit_s))
        print(rows[-1], file=sys.stderr, flush=True)
        if rows[-1].num_clusters is None:
            break
    return rows


def _row(method: str, town: _Town, limit_s: int) -> _Row:
    run = run_method(method, town.model_dir, limit_s)
    if run is None:
        return _Row(num_images=len(town.scene.image_names), method=method, cpu_s=limit_s)
    cpu_s, clusters = run
    coverage, matchability = _quality(town, clusters)
    return _Row(
        num_images=len(town.scene.image_names),
        method=method,
        cpu_s=cpu_s,
        num_clusters=len(clusters),
        views_per_cluster=float(np.mean([len(images) for images in clusters])),
        coverage=coverage,
        matchability=matchability,
    )


def _write_figure(path: Path, rows: list[_Row], scaling: Path | None) -> None:
    series = {
        method: sorted(
            (row.num_images, row.cpu_s) for row in rows if row.method == method and row.num_clusters is not None
        )
        for method in METHODS
    }
    if scaling:
        largest = max(x for x, _ in series[OURS])
        runs = json.loads(scaling.read_text())
        series[OURS] += [
            (run["num_images"], run["clustering"]["cpu_s"] + run["selection"]["cpu_s"])
            for run in runs
            if run["num_images"] > 1.05 * largest
        ]
    write_log_chart(path, series, x_title="images", y_title="CPU-seconds")


def _write_drive(wanted: int, folder: Path) -> Path:
    num_keyframes = round(wanted / len(CAMERAS))
    num_points = round(_DRIVE.num_points * num_keyframes / _DRIVE.num_keyframes)
    write_drive(replace(_DRIVE, num_keyframes=num_keyframes, num_points=num_points), folder)
    return folder


def _town(model_dir: Path, folder: Path) -> _Town:
    folder.mkdir()
    store_scene(model_dir, folder)
    scene = open_scene(folder)
    return _Town(model_dir=model_dir, scene=scene, tree=KDTree(scene.points_in_world[::_EVERY_KEYPOINT, :2]))


def _seen_keypoints(town: _Town, images: NDArray[np.int64]) -> tuple[csr_array, NDArray[np.int64]]:
    """Which image sees which keypoint from near enough: (n, k), and (k,) numbers of these keypoints in the tree."""
    keypoints = town.scene.points_in_world[::_EVERY_KEYPOINT]
    seen = [np.empty(0, dtype=np.int64)]
    for image, center in zip(images, town.scene.centers_in_world[images], strict=True):
        near = np.array(town.tree.query_ball_point(center[:2], ClusteringOptions().max_camera_distance_m), np.int64)
        seen.append(near[sees(town.scene, image, keypoints[near])])
    numbers, columns = np.unique(np.concatenate(seen), return_inverse=True)
    starts = np.cumsum([len(visible) for visible in seen])
    ones = np.ones(len(columns), dtype=np.float32)
    return csr_array((ones, columns, starts), shape=(len(images), len(numbers))), numbers


def _quality(town: _Town, clusters: Clusters) -> tuple[float, float]:
    """Coverage and matchability, from 0 to 1."""
    options = SelectionOptions()
    covered = np.zeros(town.tree.n, dtype=np.bool_)
    num_views = num_matched = 0
    for images in clusters:
        visible, keypoints = _seen_keypoints(town, images)
        covered[keypoints[np.asarray(visible.sum(axis=0)).reshape(-1) >= options.n_vis]] = True
        shared = (visible @ visible.T).toarray()
        np.fill_diagonal(shared, 0)
        partners = (shared >= options.min_shared_points / _EVERY_KEYPOINT).sum(axis=1)
        num_views += len(images)
        num_matched += int((partners >= options.n_match).sum())
    return float(covered.mean()), num_matched / num_views


if __name__ == "__main__":
    main()
