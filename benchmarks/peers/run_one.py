"""One method on one model, in a process of its own whose CPU time is limited."""

from __future__ import annotations

import json
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from app.clustering.clusters import SCENE_FOLDER
from app.scene.posed_scene import PosedScene
from app.scene.read_model import open_scene, store_scene
from app.view_selection.options import SelectionMethod
from app.view_selection.selection import read_selections
from benchmarks.peers.clique_ilp import clique_selections
from benchmarks.peers.metis_cut import metis_clusters
from benchmarks.peers.normalized_cuts import normalized_cut_clusters
from benchmarks.stage_run import run_stages

Clusters = list[NDArray[np.int64]]
_METHODS: dict[str, Callable[[PosedScene], Clusters]] = {
    "COLMAP": metis_clusters,
    "normalized cuts": normalized_cut_clusters,
    "ILP of cliques": clique_selections,
}
OURS = "cityrecon"
METHODS = (OURS, *_METHODS)


def run_method(method: str, model_dir: Path, limit_s: int) -> tuple[float, Clusters] | None:
    """CPU-seconds, and rows of the images of each cluster (selected, where the method selects).

    Reading the model counts for the program and for no other. None where the method takes more than the limit.
    """
    with tempfile.TemporaryDirectory() as scratch:
        if method == OURS:
            run = run_stages(model_dir, Path(scratch), SelectionMethod.OPTIMAL, num_workers=1)
            scene = open_scene(Path(scratch) / "clusters" / SCENE_FOLDER)
            selections = read_selections(Path(scratch) / "selection")
            return run.cpu_s, [scene.image_names.rows_of(selection.image_names) for selection in selections]
        output = Path(scratch) / "clusters.json"
        command = [sys.executable, "-m", __name__, method, str(model_dir), str(output), str(limit_s)]
        process = subprocess.run(command, check=False)
        if process.returncode == -signal.SIGXCPU:
            return None
        process.check_returncode()
        record = json.loads(output.read_text())
        return record["cpu_s"], [np.array(images, dtype=np.int64) for images in record["clusters"]]


def _main(method: str, model_dir: str, output: str, limit_s: str) -> None:
    with tempfile.TemporaryDirectory() as scratch:
        store_scene(Path(model_dir), Path(scratch))
        scene = open_scene(Path(scratch))
        started = time.process_time()
        limit = int(started) + int(limit_s)
        # Ended by SIGXCPU at the first, which no lack of memory sends.
        resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 10))
        clusters = _METHODS[method](scene)
        spent_s = time.process_time() - started
    Path(output).write_text(json.dumps({"cpu_s": spent_s, "clusters": [images.tolist() for images in clusters]}))


if __name__ == "__main__":
    _main(*sys.argv[1:])
