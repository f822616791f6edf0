"""How many clusters are reconstructed side by side, and which GPUs they get."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from app import dense_stages
from app.capture.inventory import Inventory
from app.config import RunConfig
from app.options import DensifyOptions
from app.run import Run
from app.workspace import Workspace
from mvs_backends.base import MvsOptions

JOB = """{"cameras": {"1": {"model": "PINHOLE", "width": 3200, "height": 1000, "params": [900, 900, 1600, 500]}},
"images": [], "region": {
"cells": [[0, 0]], "origin_m": [0, 0], "cell_size_m": [20, 20], "z_range_m": [0, 9], "padding_m": 2}}"""


def asked_of_tasks(
    folder: Path, monkeypatch: pytest.MonkeyPatch, *, num_clusters: int, num_jobs: int, config: RunConfig
) -> dict[str, Any]:
    """What `densify_stage` asks for, so many clusters of images of 3200x1000 given."""
    workspace = Workspace(folder / "workspace")
    workspace.inventory_file.parent.mkdir(parents=True)
    Inventory(image_root=folder, cameras=(), frames=(), images=(), is_rig=False).write(workspace.inventory_file)
    jobs = {}
    for number in range(num_clusters):
        jobs[f"cluster{number}"] = folder / f"job{number}"
        jobs[f"cluster{number}"].mkdir()
        (folder / f"job{number}" / "job.json").write_text(JOB, encoding="utf-8")
    asked: dict[str, Any] = {}

    def run_tasks(label: str, function: object, tasks: dict[str, dense_stages.Task], **how: object) -> dict[str, str]:
        asked.update(how, tasks=tasks)
        return {}

    monkeypatch.setattr(dense_stages, "run_tasks", run_tasks)
    run = Run(workspace=workspace, config=config, num_jobs=num_jobs)
    dense_stages.densify_stage(run, jobs=jobs, folder=folder / "dense", num_jobs=num_jobs)
    return asked


@pytest.mark.parametrize(
    ("num_clusters", "num_jobs", "gpu_index", "expected"),
    [
        (5, 0, "-1", ["4", "6", "7"]),
        (5, 0, "0,2", ["4", "7"]),
        (5, 2, "-1", ["4,7", "6"]),
        (1, 0, "-1", ["4,6,7"]),
    ],
)
def test_clusters_share_the_gpus(
    num_clusters: int,
    num_jobs: int,
    gpu_index: str,
    expected: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "4,6,7")
    program = tmp_path / "ACMP"
    program.touch()
    program.chmod(0o755)
    stereo = MvsOptions(acmp_path=str(program), gpu_index=gpu_index)
    config = replace(RunConfig(), densify=DensifyOptions(backend="acmp"), stereo=stereo)
    asked = asked_of_tasks(tmp_path, monkeypatch, num_clusters=num_clusters, num_jobs=num_jobs, config=config)
    assert asked["environments"] == [{"CUDA_VISIBLE_DEVICES": gpus} for gpus in expected]
    assert asked["num_workers"] == len(expected)
    for task in asked["tasks"].values():
        (given,) = [argument for argument in task.arguments if isinstance(argument, MvsOptions)]
        assert given.gpu_index == "-1", "of those that it sees"


@pytest.mark.parametrize(
    ("free_gib", "num_jobs", "limit_px", "expected"),
    [
        (100.0, 0, 1600, 8),
        (2.0, 0, 1600, 4),
        (2.0, 0, 0, 2),
        (0.1, 0, 1600, 1),
        (2.0, 7, 1600, 7),
    ],
    ids=["enough", "some", "of full size", "too little", "as the user says"],
)
def test_clusters_share_the_memory(
    free_gib: float, num_jobs: int, limit_px: int, expected: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(8)))
    monkeypatch.setattr(dense_stages, "memory_budget_gib", lambda _: free_gib)
    config = replace(RunConfig(), densify=DensifyOptions(backend="patchmatch", max_image_size_px=limit_px))
    asked = asked_of_tasks(tmp_path, monkeypatch, num_clusters=20, num_jobs=num_jobs, config=config)
    assert asked["num_workers"] == expected
