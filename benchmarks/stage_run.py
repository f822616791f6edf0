"""Clustering and selection of a model in a fresh process, with what they took."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

from app.clustering.options import BlockVisibility, ClusteringOptions
from app.clustering.stage import cluster
from app.view_selection.options import SelectionMethod, SelectionOptions, Visibility
from app.view_selection.stage import select


@dataclass(frozen=True, kw_only=True)
class Cost:
    """What a stage took, reading its input and writing its results included."""

    wall_s: float
    cpu_s: float
    """User and system, of the process and its workers."""


@dataclass(frozen=True, kw_only=True)
class StageRun:
    """Both stages of a model."""

    clustering: Cost
    selection: Cost
    process_gib: float
    """Peak resident memory of the process."""
    worker_gib: float
    """Peak resident memory of the largest worker."""

    @property
    def cpu_s(self) -> float:
        """Of both stages."""
        return self.clustering.cpu_s + self.selection.cpu_s

    @property
    def wall_s(self) -> float:
        """Of both stages."""
        return self.clustering.wall_s + self.selection.wall_s


def run_stages(model_dir: Path, output_dir: Path, method: SelectionMethod, num_workers: int) -> StageRun:
    """Cluster and select in a new process, as the commands do.

    Args:
        model_dir: COLMAP model.
        output_dir: Gets ``clusters/`` and ``selection/``.
        method: Of selection.
        num_workers: Of selection.
    """
    command = [sys.executable, "-m", __name__, str(model_dir), str(output_dir), method, str(num_workers)]
    finished = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    record = json.loads(finished.stdout)
    record["clustering"], record["selection"] = Cost(**record["clustering"]), Cost(**record["selection"])
    return StageRun(**record)


def _main(model_dir: str, output_dir: str, method: str, num_workers: str) -> None:
    folder = Path(output_dir)
    (folder / "clusters").mkdir(parents=True, exist_ok=True)
    started = _now()
    # As in [O]: nothing hides anything.
    clustering = ClusteringOptions(visibility=BlockVisibility.FRUSTUM)
    cluster(Path(model_dir), folder / "clusters", options=clustering)
    clustered = _now()
    selection = SelectionOptions(method=SelectionMethod(method), visibility=Visibility.FRUSTUM)
    select(folder / "clusters", folder / "selection", options=selection, num_workers=int(num_workers))
    selected = _now()
    usage = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    run = StageRun(
        clustering=Cost(wall_s=clustered[0] - started[0], cpu_s=clustered[1] - started[1]),
        selection=Cost(wall_s=selected[0] - clustered[0], cpu_s=selected[1] - clustered[1]),
        process_gib=usage[0].ru_maxrss / 2**20,
        worker_gib=usage[1].ru_maxrss / 2**20,
    )
    print(json.dumps(asdict(run)))


def _now() -> tuple[float, float]:
    usage = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return time.perf_counter(), sum(used.ru_utime + used.ru_stime for used in usage)


if __name__ == "__main__":
    _main(*sys.argv[1:])
