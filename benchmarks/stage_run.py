"""Clustering and selection of a model in a fresh process, with what they took."""

from __future__ import annotations

import json
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from app import cli  # noqa: F401 - for what it sets for all processes of a command
from app.clustering.options import BlockVisibility, ClusteringOptions
from app.clustering.stage import cluster
from app.view_selection.options import SelectionMethod, SelectionOptions, Visibility
from app.view_selection.stage import select

MAX_PICTURES = SelectionOptions().max_pictures


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
    peak_gib: float
    """Peak resident memory of the process and its workers together, mapped files included, shared pages counted once.
    Read from the system every second, as the peaks that it keeps count shared pages in each process."""

    @property
    def cpu_s(self) -> float:
        """Of both stages."""
        return self.clustering.cpu_s + self.selection.cpu_s

    @property
    def wall_s(self) -> float:
        """Of both stages."""
        return self.clustering.wall_s + self.selection.wall_s


def median_run(runs: Sequence[StageRun]) -> StageRun:
    """The median of each figure."""

    def median(costs: list[Cost]) -> Cost:
        return Cost(wall_s=statistics.median(c.wall_s for c in costs), cpu_s=statistics.median(c.cpu_s for c in costs))

    return StageRun(
        clustering=median([run.clustering for run in runs]),
        selection=median([run.selection for run in runs]),
        peak_gib=statistics.median(run.peak_gib for run in runs),
    )


def run_stages(
    model_dir: Path, output_dir: Path, method: SelectionMethod, num_workers: int, max_pictures: int = MAX_PICTURES
) -> StageRun:
    """Cluster and select in a new process, as the commands do.

    Args:
        model_dir: COLMAP model.
        output_dir: Gets ``clusters/`` and ``selection/``.
        method: Of selection.
        num_workers: Of selection.
        max_pictures: Of selection.
    """
    values = map(str, (model_dir, output_dir, method, num_workers, max_pictures))
    command = [sys.executable, "-m", __name__, *values]
    peak_gib = 0.0
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        while process.poll() is None:
            peak_gib = max(peak_gib, _resident_gib(process.pid))
            time.sleep(1.0)
        output = process.stdout.read() if process.stdout else ""
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command)
    record = json.loads(output)
    return StageRun(clustering=Cost(**record["clustering"]), selection=Cost(**record["selection"]), peak_gib=peak_gib)


def _resident_gib(pid: int) -> float:
    """Proportional set size of a process and all its descendants; 0 for those that have just ended."""
    folder = Path("/proc") / str(pid)
    try:
        lines = (folder / "smaps_rollup").read_text().splitlines()
        children = (folder / "task" / str(pid) / "children").read_text().split()
    except OSError:
        return 0.0
    own_kib = next((int(line.split()[1]) for line in lines if line.startswith("Pss:")), 0)
    return own_kib / 2**20 + sum(_resident_gib(int(child)) for child in children)


def _main(model_dir: str, output_dir: str, method: str, num_workers: str, max_pictures: str) -> None:
    folder = Path(output_dir)
    (folder / "clusters").mkdir(parents=True, exist_ok=True)
    started = _now()
    # As in [O]: nothing hides anything.
    clustering = ClusteringOptions(visibility=BlockVisibility.FRUSTUM)
    cluster(Path(model_dir), folder / "clusters", options=clustering)
    clustered = _now()
    selection = SelectionOptions(
        method=SelectionMethod(method), visibility=Visibility.FRUSTUM, max_pictures=int(max_pictures)
    )
    select(folder / "clusters", folder / "selection", options=selection, num_workers=int(num_workers))
    selected = _now()
    costs = {
        "clustering": Cost(wall_s=clustered[0] - started[0], cpu_s=clustered[1] - started[1]),
        "selection": Cost(wall_s=selected[0] - clustered[0], cpu_s=selected[1] - clustered[1]),
    }
    print(json.dumps({name: asdict(cost) for name, cost in costs.items()}))


def _now() -> tuple[float, float]:
    usage = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return time.perf_counter(), sum(used.ru_utime + used.ru_stime for used in usage)


if __name__ == "__main__":
    _main(*sys.argv[1:])
