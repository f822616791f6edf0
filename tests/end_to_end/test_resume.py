"""Killed, failed, repeated and changed runs: the same command ends in the same bytes and repeats no finished work."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from app.config import read_config
from app.densify import densify_inputs
from app.stage import is_current
from app.workspace import Workspace
from fusion.cloud import read_ply
from mvs_backends import choose_backend
from tests.small_street import OPTIONS, FinishedRun, cityrecon, error_lines, kill_when, refused

KILL_IN_MERGE = """
import os, signal
import fusion.merge
append = fusion.merge.PlyWriter.append
def die(writer, cloud):
    append(writer, cloud)
    os.kill(os.getpid(), signal.SIGKILL)
fusion.merge.PlyWriter.append = die
"""


def records(workspace: Path, stage: str) -> dict[str, int]:
    """When each finished folder of a stage was made."""
    return {path.parent.name: path.stat().st_mtime_ns for path in (workspace / stage).rglob("record.json")}


def views_by_cluster(workspace: Path) -> dict[str, list[str]]:
    return {
        job.parent.name: [image["name"] for image in json.loads(job.read_text())["images"]]
        for job in (workspace / "jobs").glob("*/job.json")
    }


def test_killed_while_densifying_fusing_and_merging(finished_run: FinishedRun, tmp_path: Path) -> None:
    workspace, out = finished_run.copy_to(tmp_path), tmp_path / "town.ply"
    shutil.rmtree(workspace / "dense")
    shutil.rmtree(workspace / "fused")
    full = finished_run.full(out, "--workspace", workspace)

    def inside_a_cluster() -> bool:
        return any(workspace.glob("dense/*.partial/stereo/patchmatch/pass0_view00002"))

    kill_when(inside_a_cluster, *full)
    kept = {path: path.stat().st_mtime_ns for path in workspace.glob("dense/*.partial/stereo/patchmatch/pass*/*.npy")}
    assert kept
    assert not out.exists()
    assert not any(path.suffix != ".partial" for path in (workspace / "dense").iterdir())

    def maps_are_there() -> bool:
        unchanged = all(path.stat().st_mtime_ns == made for path, made in kept.items())
        assert unchanged, "the passes of the first run were done again"
        return any(workspace.glob("dense/*.partial/stereo/depth_maps/*/*.geometric.bin"))

    kill_when(maps_are_there, *full)
    kill_when(lambda: any(workspace.glob("fused/*/record.json")), *full)
    dense, fused = records(workspace, "dense"), records(workspace, "fused")
    assert not out.exists()
    killed = cityrecon(*full, before=KILL_IN_MERGE)
    assert killed.returncode == -9
    assert not out.exists()
    assert records(workspace, "dense") == dense

    result = cityrecon(*full)
    assert result.returncode == 0, result.stderr
    assert out.read_bytes() == finished_run.out.read_bytes()
    assert records(workspace, "dense") == dense
    assert fused.items() <= records(workspace, "fused").items()
    assert not list(tmp_path.rglob("*.partial"))


def test_killed_in_sfm(finished_run: FinishedRun, tmp_path: Path) -> None:
    workspace = finished_run.copy_to(tmp_path)
    shutil.rmtree(workspace / "sfm")
    kill_when(lambda: (workspace / "sfm.partial" / "database.db").exists(), "sfm", workspace)
    assert not (workspace / "sfm").exists()
    assert "cityrecon sfm" in refused(cityrecon("georegister", workspace))
    result = cityrecon("sfm", workspace)
    assert result.returncode == 0, result.stderr
    for name in ("cameras", "images", "points3D", "rigs", "frames"):
        file = Path("sfm") / "model" / f"{name}.bin"
        assert (workspace / file).read_bytes() == (finished_run.workspace / file).read_bytes(), name
    assert "up to date" in cityrecon("georegister", workspace).stderr


def test_one_failing_cluster_does_not_end_the_others(finished_run: FinishedRun, tmp_path: Path) -> None:
    """An image that only some clusters use disappears, and comes back."""
    workspace = finished_run.copy_to(tmp_path)
    views = views_by_cluster(workspace)
    uses = Counter(name for names in views.values() for name in names)
    lost, cluster = min(
        ((name, cluster) for cluster, names in views.items() for name in names if uses[name] == 1),
        key=lambda pair: len(views[pair[1]]),
    )
    other = min((name for name in views if name != cluster), key=lambda name: len(views[name]))
    for name in (cluster, other):
        shutil.rmtree(workspace / "dense" / name)
        shutil.rmtree(workspace / "fused" / name)
    image = finished_run.scene / "images" / lost
    hidden = image.with_suffix(".hidden")
    image.rename(hidden)
    try:
        result = cityrecon("densify", workspace)
        assert result.returncode == 1
        assert error_lines(result)[0].startswith(f"error: densify: {cluster} failed: cannot read {image}")
        assert error_lines(result)[1].startswith(f"error: 1 of {len(views)} clusters failed, first {cluster}")
        assert set(records(workspace, "dense")) == set(views) - {cluster}

        out = tmp_path / "out.ply"
        result = cityrecon("fuse", workspace, "--out", out)
        assert result.returncode == 1
        assert "run `cityrecon densify` first" in error_lines(result)[0]
        assert not out.exists()

        assert cityrecon("densify", workspace, "--allow-partial").returncode == 0
        result = cityrecon("fuse", workspace, "--out", out, "--allow-partial")
        assert result.returncode == 0, result.stderr
        assert f"warning: 1 of {len(views)} clusters failed, first {cluster}" in result.stderr
        assert 0 < out.stat().st_size <= finished_run.out.stat().st_size
    finally:
        hidden.rename(image)
    result = cityrecon(*finished_run.full(out, "--workspace", workspace))
    assert result.returncode == 0, result.stderr
    assert out.read_bytes() == finished_run.out.read_bytes()


def test_a_second_run_on_a_workspace_is_refused(finished_run: FinishedRun) -> None:
    handle = os.open(finished_run.workspace / ".lock", os.O_RDWR)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        message = refused(cityrecon("cluster", finished_run.workspace), exit_code=1)
    finally:
        os.close(handle)
    assert "another run is using workspace" in message


def test_a_fusion_option_redoes_fusion_only(finished_run: FinishedRun, tmp_path: Path) -> None:
    workspace, out = finished_run.copy_to(tmp_path), tmp_path / "out.ply"
    before = {stage: records(workspace, stage) for stage in ("sfm", "georegister", "clusters", "selection", "dense")}
    fused = records(workspace, "fused")
    result = cityrecon("fuse", workspace, "--out", out, "--min-num-pixels", "4")
    assert result.returncode == 0, result.stderr
    assert {stage: records(workspace, stage) for stage in before} == before
    assert all(made > fused[name] for name, made in records(workspace, "fused").items())
    assert out.stat().st_size < finished_run.out.stat().st_size
    coarse = tmp_path / "coarse.ply"
    result = cityrecon("fuse", workspace, "--out", coarse, "--min-num-pixels", "4", "--voxel-m", "0.1")
    assert result.returncode == 0, result.stderr
    whole, thinned = (
        np.unique(np.floor(read_ply(path).points.astype(np.float64) / 0.1), axis=0) for path in (out, coarse)
    )
    np.testing.assert_array_equal(thinned, whole)
    assert len(read_ply(coarse)) < 1.02 * len(thinned), "one point per voxel, and per cluster at the borders of cells"


def test_a_selection_option_redoes_the_clusters_whose_views_changed(finished_run: FinishedRun, tmp_path: Path) -> None:
    workspace = finished_run.copy_to(tmp_path)
    before = views_by_cluster(workspace)
    assert cityrecon("select", workspace, "--min-views-fraction", "0.9").returncode == 0
    result = cityrecon("densify", workspace, "--dry-run")
    assert result.returncode == 0, result.stderr
    after = views_by_cluster(workspace)
    changed = {name for name in after if after[name] != before.get(name)}
    assert changed, "choose an option that changes more"
    config = read_config(Workspace(workspace).config_file)
    backend = choose_backend(config.densify.backend, config.stereo)
    options = {"densify": replace(config.densify, backend=backend), "stereo": config.stereo}
    current = {
        name
        for name in after
        if is_current(workspace / "dense" / name, options=options, inputs=densify_inputs(workspace / "jobs" / name))
    }
    assert current == set(after) - changed
    assert f"densify: {len(changed)} of {len(after)} jobs to do" in result.stderr


def test_an_updated_stage_is_redone_and_nothing_that_did_not_change_by_it(
    finished_run: FinishedRun, tmp_path: Path
) -> None:
    workspace = finished_run.copy_to(tmp_path)
    update = "import app.versions; app.versions._VERSIONS['cluster'] += 1"
    assert (
        "clusters: redoing, because of changed program version" in cityrecon("cluster", workspace, before=update).stderr
    )
    assert "clusters: up to date" in cityrecon("cluster", workspace, before=update).stderr
    assert "selection: up to date" in cityrecon("select", workspace, before=update).stderr


def test_a_rig_file_changed_in_place_is_noticed(finished_run: FinishedRun, tmp_path: Path) -> None:
    workspace = finished_run.copy_to(tmp_path)
    rig = tmp_path / "rig.json"
    shutil.copy(finished_run.scene / "rig.json", rig)
    arguments = ("capture", finished_run.scene / "images", workspace, "--rig", rig, *OPTIONS[2:])
    products = []
    for text in (rig.read_text(), rig.read_text().replace("-0.04", "-0.05")):
        rig.write_text(text)
        result = cityrecon(*arguments)
        assert result.returncode == 0, result.stderr
        products.append(json.loads((workspace / "capture" / "record.json").read_text())["product"])
    assert products[0] != products[1]


@pytest.mark.parametrize("stage", ["capture", "dense"])
def test_a_workspace_of_a_newer_program_is_refused(finished_run: FinishedRun, tmp_path: Path, stage: str) -> None:
    workspace = finished_run.copy_to(tmp_path)
    record = next((workspace / stage).rglob("record.json"))
    record.write_text(record.read_text().replace('"format_version": 1', '"format_version": 2'))
    out = tmp_path / "out.ply"
    assert "newer cityrecon" in refused(cityrecon(*finished_run.full(out, "--workspace", workspace)))
    assert not out.exists()
