"""Time and quality of the program and of other methods against the number of images, and a figure of the times.

python -m benchmarks.peers OUTPUT.json FIGURE.svg [--limit-s 3600] [--images 250 500 1000 2000 4000 8000 12000]
                           [--methods METHOD ...] [--scaling SCALING.json]

The drives are like seq5, one for each number of images. A method isn't tried on more images once it has taken more
than the limit, in CPU-seconds. What OUTPUT.json holds from earlier runs stays. ``--scaling`` adds the program's times
from `benchmarks.scaling` to the figure.

Coverage: keypoints that at least two images of one cluster see, projecting into them from within 38 m. Matchability:
images of a cluster that see 20 common keypoints with at least two others of it. Both on every fourth keypoint.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.sparse import csr_array, vstack

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


def main() -> None:
    """Print a row per method and number of images; write them and the figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path)
    parser.add_argument("figure", type=Path)
    parser.add_argument("--limit-s", type=int, default=3600)
    parser.add_argument("--images", type=int, nargs="+", default=[250, 500, 1000, 2000, 4000, 8000, 12000])
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=METHODS)
    parser.add_argument("--scaling", type=Path)
    arguments = parser.parse_args()
    print(describe_machine())
    print(f"{_DRIVE}; limit {arguments.limit_s} CPU-s")
    print("| images | method | CPU-s | clusters | views per cluster | coverage | matchability |")
    print("|---|---|---|---|---|---|---|")
    rows = json.loads(arguments.output.read_text()) if arguments.output.exists() else []
    given_up: set[str] = set()
    for wanted in sorted(arguments.images):
        with tempfile.TemporaryDirectory() as scratch:
            num_images = _write_model(wanted, Path(scratch) / "model")
            store_scene(Path(scratch) / "model", Path(scratch) / "scene")
            scene = open_scene(Path(scratch) / "scene")
            seen = _seen_keypoints(scene)
            for method in arguments.methods:
                if method in given_up:
                    continue
                run = run_method(method, Path(scratch) / "model", arguments.limit_s)
                if run is None:
                    given_up.add(method)
                    print(f"| {num_images:,} | {method} | over {arguments.limit_s} | | | | |", flush=True)
                    continue
                coverage, matchability = _quality(seen, run[1])
                views = float(np.mean([len(images) for images in run[1]]))
                rows.append({"num_images": num_images, "method": method, "cpu_s": run[0]})
                print(
                    f"| {num_images:,} | {method} | {run[0]:.1f} | {len(run[1])} | {views:.1f} "
                    f"| {100 * coverage:.1f} % | {100 * matchability:.1f} % |",
                    flush=True,
                )
                arguments.output.write_text(json.dumps(rows, indent=1) + "\n")
    series = {
        method: sorted((row["num_images"], row["cpu_s"]) for row in rows if row["method"] == method)
        for method in METHODS
    }
    if arguments.scaling:
        largest = max(x for x, _ in series[OURS])
        runs = json.loads(arguments.scaling.read_text())
        series[OURS] += [
            (run["num_images"], run["clustering"]["cpu_s"] + run["selection"]["cpu_s"])
            for run in runs
            if run["num_images"] > 1.05 * largest
        ]
    write_log_chart(arguments.figure, series, x_title="images", y_title="CPU-seconds")


def _write_model(wanted: int, folder: Path) -> int:
    num_keyframes = round(wanted / len(CAMERAS))
    num_points = round(_DRIVE.num_points * num_keyframes / _DRIVE.num_keyframes)
    write_drive(replace(_DRIVE, num_keyframes=num_keyframes, num_points=num_points), folder)
    return num_keyframes * len(CAMERAS)


def _seen_keypoints(scene: PosedScene) -> csr_array:
    """(N, P / 4) which image sees which keypoint from near enough."""
    keypoints = scene.points_in_world[::_EVERY_KEYPOINT]
    reach = ClusteringOptions().max_camera_distance_m
    rows = []
    for image, center in enumerate(scene.centers_in_world):
        near = np.flatnonzero(np.hypot(*(keypoints[:, :2] - center[:2]).T) <= reach)
        visible = near[sees(scene, image, keypoints[near])]
        ones = np.ones(len(visible), dtype=np.float32)
        rows.append(csr_array((ones, visible, np.array([0, len(visible)])), shape=(1, len(keypoints))))
    return vstack(rows, format="csr")


def _quality(seen: csr_array, clusters: Clusters) -> tuple[float, float]:
    """Coverage and matchability, from 0 to 1."""
    options = SelectionOptions()
    covered = np.zeros(seen.shape[1], dtype=np.bool_)
    num_views = num_matched = 0
    for images in clusters:
        visible = seen[images]
        covered |= np.asarray(visible.sum(axis=0)).reshape(-1) >= options.n_vis
        shared = (visible @ visible.T).toarray()
        np.fill_diagonal(shared, 0)
        partners = (shared >= options.min_shared_points / _EVERY_KEYPOINT).sum(axis=1)
        num_views += len(images)
        num_matched += int((partners >= options.n_match).sum())
    return float(covered.mean()), num_matched / num_views


if __name__ == "__main__":
    main()
