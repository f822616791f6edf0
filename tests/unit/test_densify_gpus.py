"""Which GPUs the clusters get."""

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

JOB = """{"cameras": {}, "images": [], "region": {
"cells": [[0, 0]], "origin_m": [0, 0], "cell_size_m": [20, 20], "z_range_m": [0, 9], "padding_m": 2}}"""


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
    workspace = Workspace(tmp_path / "workspace")
    workspace.inventory_file.parent.mkdir(parents=True)
    Inventory(image_root=tmp_path, cameras=(), frames=(), images=(), is_rig=False).write(workspace.inventory_file)
    jobs = {}
    for number in range(num_clusters):
        jobs[f"cluster{number}"] = tmp_path / f"job{number}"
        jobs[f"cluster{number}"].mkdir()
        (tmp_path / f"job{number}" / "job.json").write_text(JOB, encoding="utf-8")
    stereo = MvsOptions(acmp_path=str(program), gpu_index=gpu_index)
    config = replace(RunConfig(), densify=DensifyOptions(backend="acmp"), stereo=stereo)
    asked: dict[str, Any] = {}

    def run_tasks(label: str, function: object, tasks: dict[str, dense_stages.Task], **how: object) -> dict[str, str]:
        asked.update(how, tasks=tasks)
        return {}

    monkeypatch.setattr(dense_stages, "run_tasks", run_tasks)
    run = Run(workspace=workspace, config=config, num_jobs=num_jobs)
    dense_stages.densify_stage(run, jobs=jobs, folder=tmp_path / "dense", num_jobs=num_jobs)
    assert asked["environments"] == [{"CUDA_VISIBLE_DEVICES": gpus} for gpus in expected]
    assert asked["num_workers"] == len(expected)
    for task in asked["tasks"].values():
        (given,) = [argument for argument in task.arguments if isinstance(argument, MvsOptions)]
        assert given.gpu_index == "-1", "of those that it sees"
