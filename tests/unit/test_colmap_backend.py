"""What only COLMAP's back-end does; the rest is in `test_backend_contract.py`."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from mvs_backends import choose_backend, get_backend
from mvs_backends.base import MvsError, MvsJob, MvsOptions
from mvs_backends.colmap import _groups, _try_out
from mvs_backends.depth_range import depth_range
from mvs_backends.hardware import installed_gpus
from mvs_backends.trial import trial_job, trials_file
from tests.reference.plane_scene import plane_job, write_model
from tests.unit.test_backend_contract import install

TRIAL_PLANE = "0 0 1 10"
"""10 in front of the cameras, parallel to the images."""


@pytest.fixture
def options(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> MvsOptions:
    monkeypatch.setenv("PLANE", TRIAL_PLANE)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    forget()
    return install("colmap", tmp_path / "bin")


def forget() -> None:
    """As in another process."""
    _try_out.cache_clear()
    installed_gpus.cache_clear()


@pytest.fixture
def job(tmp_path: Path) -> MvsJob:
    made = plane_job(tmp_path / "job", normal=(0.0, 0.0, 1.0))
    write_model(made)
    return made


def test_views_at_other_distances_get_other_depth_ranges(job: MvsJob) -> None:
    """One camera 40 away from the others: each view in one group, whose range holds all it sees of the region."""
    far = job.views[3].cam_from_world.copy()
    far[2, 3] += 40.0
    job = replace(job, views=(*job.views[:3], replace(job.views[3], cam_from_world=far)))
    groups = _groups(job, range(4))
    assert sorted(view for _, views in groups for view in views) == [0, 1, 2, 3]
    assert len(groups) > 1
    for (near, end), views in groups:
        for view in views:
            entry, leave = depth_range(job.views[view], job.boxes_in_world, 56, 40)
            hit = leave > 0
            assert near <= entry[hit].min() and leave[hit].max() <= end * (1 + 1e-9)
            assert end / near < 16


@pytest.mark.parametrize(
    ("fault", "why"),
    [("", "succeeded"), ("exit", "requires CUDA"), ("wrong", "found wrong depths"), ("kill", "SIGKILL")],
)
def test_auto_is_what_really_works(fault: str, why: str, options: MvsOptions, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FAULT", fault)
    assert choose_backend("auto", options) == ("patchmatch" if fault else "colmap")
    availability = get_backend("colmap").availability(options)
    assert availability.ok == (not fault)
    assert why in availability.reason and "\n" not in availability.reason
    assert choose_backend("patchmatch", options) == "patchmatch"


def test_trial_views_are_far_enough_apart_for_colmap(tmp_path: Path) -> None:
    """COLMAP drops what its views see at less than 3 degrees: with 3.05 in the middle, a trial failed on a real GPU."""
    job, depth = trial_job(tmp_path)
    centers = [-view.cam_from_world[:, :3].T @ view.cam_from_world[:, 3] for view in job.views]
    middle = job.views[1]
    corners = np.array([(x, y, 1.0) for x in (0, middle.width) for y in (0, middle.height)])
    points = centers[1] + depth * corners @ np.linalg.inv(middle.calibration).T
    for neighbour in (centers[0], centers[2]):
        rays = [
            (points - center) / np.linalg.norm(points - center, axis=1)[:, None] for center in (centers[1], neighbour)
        ]
        assert (np.degrees(np.arccos((rays[0] * rays[1]).sum(axis=1))) > 3.5).all()


def test_a_trial_is_remembered(options: MvsOptions, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A success until the program or the GPUs change, a failure for an hour; a broken memory is none."""

    def works() -> bool:
        forget()
        return get_backend("colmap").availability(options).ok

    assert works()
    monkeypatch.setenv("FAULT", "exit")
    assert works(), "remembered"
    smi = tmp_path / "bin" / "nvidia-smi"
    smi.write_text("#!/bin/sh\necho 'H100, GPU-1, 550.1'\n", encoding="utf-8")
    smi.chmod(0o755)
    monkeypatch.setenv("PATH", str(smi.parent), prepend=":")
    assert not works(), "another GPU"
    (tmp_path / "bin" / "colmap").touch()
    monkeypatch.delenv("FAULT")
    smi.unlink()
    assert works(), "another executable"
    data = json.loads(trials_file().read_text(encoding="utf-8"))
    assert len(data) == 3
    for trial in data.values():
        trial |= {"time": "2020-01-01 00:00:00", "problem": "none"}
    trials_file().write_text(json.dumps(data), encoding="utf-8")
    assert works(), "a failure holds for an hour"
    trials_file().write_text("{", encoding="utf-8")
    assert works()


def test_memory_and_gpus_that_colmap_gets(job: MvsJob, options: MvsOptions, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PLANE", "0 0 1 5")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "4,6,7")
    get_backend("colmap").estimate(job=job, options=replace(options, gpu_index="1,2"), num_threads=1)
    log = (job.workspace / "stereo" / "colmap.log").read_text(encoding="utf-8")
    assert "GPUs 6,7," in log
    gib = float(log.partition("GPUs 6,7, ")[2].partition(" GB")[0])
    assert 0 < gib < 1024
    with pytest.raises(MvsError, match="there is no GPU 3, only 3"):
        get_backend("colmap").estimate(job=job, options=replace(options, gpu_index="3"), num_threads=1)


def test_pycolmap_with_cuda_reads_our_workspace(job: MvsJob) -> None:
    """COLMAP's own parser, up to the GPU or the lack of one."""
    if not pycolmap.has_cuda:
        pytest.skip("pycolmap is built without CUDA")
    try:
        get_backend("colmap").estimate(job=job, options=MvsOptions(), num_threads=1)
    except MvsError:
        log = (job.workspace / "stereo" / "colmap.log").read_text(encoding="utf-8")
        assert "Configuration has 4 problems" in log
    else:
        assert all(np.any(job.depth_map_path(view).stat().st_size) for view in range(4))


def test_a_comma_in_an_image_name(job: MvsJob, options: MvsOptions) -> None:
    views = (replace(job.views[0], name="cam/a, b.png"), *job.views[1:])
    with pytest.raises(MvsError, match="comma"):
        get_backend("colmap").estimate(job=replace(job, views=views), options=options, num_threads=1)
