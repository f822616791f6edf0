"""COLMAP's adapter against a program that reads the workspace by COLMAP's rules and answers with the truth."""

from __future__ import annotations

import stat
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from mvs_backends import choose_backend, get_backend
from mvs_backends.base import MvsError, MvsJob, MvsOptions
from mvs_backends.colmap import _groups, _try_out
from mvs_backends.depth_range import depth_range
from tests.reference.colmap_maps import read_map
from tests.reference.plane_scene import plane_job, true_depth

STAND_IN = Path(__file__).parents[1] / "stand_ins" / "colmap.py"
NORMAL, OFFSET = np.array([0.4, 0.2, 1.0]) / np.linalg.norm([0.4, 0.2, 1.0]), 5.0


@pytest.fixture
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    executable = tmp_path / "bin" / "colmap"
    executable.parent.mkdir()
    executable.write_text(f"#!{sys.executable}\n{STAND_IN.read_text(encoding='utf-8')}", encoding="utf-8")
    executable.chmod(executable.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PLANE", " ".join(map(str, [*NORMAL, OFFSET])))
    _try_out.cache_clear()
    return executable


@pytest.fixture
def job(tmp_path: Path) -> MvsJob:
    """With the model that COLMAP reads."""
    made = plane_job(tmp_path / "job", normal=(0.4, 0.2, 1.0), size=(224, 160))
    model = pycolmap.Reconstruction()
    for index, view in enumerate(made.views, start=1):
        k = view.calibration
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(
                camera_id=index,
                model="PINHOLE",
                width=view.width,
                height=view.height,
                params=[k[0, 0], k[1, 1], k[0, 2], k[1, 2]],
            )
        )
        image = pycolmap.Image(name=view.name, camera_id=index, image_id=index)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(view.cam_from_world))
        for path in (made.depth_map_path(index - 1), made.normal_map_path(index - 1)):
            path.parent.mkdir(parents=True, exist_ok=True)
    (made.workspace / "sparse").mkdir()
    model.write_binary(made.workspace / "sparse")
    return made


def options(program: Path, **more: float) -> MvsOptions:
    return MvsOptions(colmap_path=str(program), **more)  # type: ignore[arg-type]


def check_truth(job: MvsJob) -> None:
    for view, camera in enumerate(job.views):
        depth, normal = read_map(job.depth_map_path(view)), read_map(job.normal_map_path(view))
        np.testing.assert_allclose(depth, true_depth(camera, NORMAL, OFFSET), rtol=1e-5)
        np.testing.assert_allclose(
            normal, np.broadcast_to(camera.cam_from_world[:, :3] @ -NORMAL, normal.shape), atol=1e-5
        )


def test_maps_are_the_truth(program: Path, job: MvsJob) -> None:
    done = []
    get_backend("colmap").estimate(
        job=job, options=options(program), num_threads=1, progress=lambda count, total: done.append((count, total))
    )
    check_truth(job)
    assert done[-1] == (4, 4)


def test_views_at_other_distances_get_other_depth_ranges(job: MvsJob) -> None:
    """One camera 40 away from the others: each view in one group, whose range holds all it sees of the region."""
    far = job.views[3].cam_from_world.copy()
    far[2, 3] += 40.0
    job = replace(job, views=(*job.views[:3], replace(job.views[3], cam_from_world=far)))
    groups = _groups(job)
    assert sorted(view for _, views in groups for view in views) == [0, 1, 2, 3]
    assert len(groups) > 1
    for (near, end), views in groups:
        for view in views:
            entry, leave = depth_range(job.views[view], job.boxes_in_world, 56, 40)
            hit = leave > 0
            assert near <= entry[hit].min() and leave[hit].max() <= end * (1 + 1e-9)
            assert end / near < 16


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("exit", "colmap ended with exit code 1; its last lines: .*requires CUDA"),
        ("abort", "colmap was ended by SIGABRT"),
        ("hang", "colmap ran longer than 2 s"),
        ("partial", "COLMAP left no maps of cam/000.png"),
    ],
)
def test_faults_are_told_in_one_line(
    fault: str, message: str, program: Path, job: MvsJob, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FAULT", fault)
    with pytest.raises(MvsError, match=message) as caught:
        get_backend("colmap").estimate(
            job=job, options=options(program, program_timeout_s=2 if fault == "hang" else 0), num_threads=1
        )
    assert "\n" not in str(caught.value)
    monkeypatch.delenv("FAULT")
    get_backend("colmap").estimate(job=job, options=options(program), num_threads=1)
    check_truth(job)


def test_a_map_cut_short_is_made_again(program: Path, job: MvsJob) -> None:
    backend = get_backend("colmap")
    backend.estimate(job=job, options=options(program), num_threads=1)
    path = job.depth_map_path(1)
    path.write_bytes(path.read_bytes()[:1000])
    backend.estimate(job=job, options=options(program), num_threads=1)
    check_truth(job)


def test_auto_is_what_really_works(program: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The trial's plane lies 10 in front of the cameras, parallel to them."""
    monkeypatch.setenv("PLANE", "0 0 1 10")
    assert choose_backend("auto", options(program)) == "colmap"
    assert get_backend("colmap").availability(options(program)).ok
    for fault, why in (("exit", "requires CUDA"), ("wrong", "found wrong depths"), ("abort", "SIGABRT")):
        monkeypatch.setenv("FAULT", fault)
        _try_out.cache_clear()
        assert choose_backend("auto", options(program)) == "patchmatch"
        availability = get_backend("colmap").availability(options(program))
        assert not availability.ok and why in availability.reason and "\n" not in availability.reason
    assert choose_backend("patchmatch", options(program)) == "patchmatch"


def test_without_cuda_and_executable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if pycolmap.has_cuda:
        pytest.skip("pycolmap is built with CUDA")
    monkeypatch.setenv("PATH", str(tmp_path))
    availability = get_backend("colmap").availability(MvsOptions())
    assert not availability.ok and "pycolmap-cuda12" in availability.reason


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
        check_truth(job)


def test_a_comma_in_an_image_name(program: Path, job: MvsJob) -> None:
    views = (replace(job.views[0], name="cam/a, b.png"), *job.views[1:])
    with pytest.raises(MvsError, match="comma"):
        get_backend("colmap").estimate(job=replace(job, views=views), options=options(program), num_threads=1)
