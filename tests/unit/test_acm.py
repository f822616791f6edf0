"""ACMP's adapter against a program that reads its input by ACMP's rules and answers with the truth."""

from __future__ import annotations

import os
import stat
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from mvs_backends import get_backend
from mvs_backends.acm import PROGRAMS
from mvs_backends.base import MvsError, MvsJob, MvsOptions
from tests.reference.colmap_maps import read_map
from tests.reference.plane_scene import plane_job, true_depth

STAND_IN = Path(__file__).parents[1] / "stand_ins" / "acm.py"
NORMAL, OFFSET = np.array([0.4, 0.2, 1.0]) / np.linalg.norm([0.4, 0.2, 1.0]), 5.0


@pytest.fixture
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with an executable of each name."""
    folder = tmp_path / "bin"
    folder.mkdir()
    for name in PROGRAMS:
        executable = folder / name
        executable.write_text(f"#!{sys.executable}\n{STAND_IN.read_text(encoding='utf-8')}", encoding="utf-8")
        executable.chmod(executable.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PLANE", " ".join(map(str, [*NORMAL, OFFSET])))
    return folder


@pytest.fixture
def job(tmp_path: Path) -> MvsJob:
    return plane_job(tmp_path / "job", normal=(0.4, 0.2, 1.0), size=(224, 160), scale=1.0)


def maps(job: MvsJob, view: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    return read_map(job.depth_map_path(view)), read_map(job.normal_map_path(view))


@pytest.mark.parametrize("name", PROGRAMS)
def test_maps_are_the_truth_in_colmaps_frame(name: str, program: Path, job: MvsJob) -> None:
    done = []
    get_backend(name.lower()).estimate(
        job=job,
        options=MvsOptions(acmp_path=str(program)),
        num_threads=1,
        progress=lambda count, total: done.append((count, total)),
    )
    for view, camera in enumerate(job.views):
        depth, normal = maps(job, view)
        truth = true_depth(camera, NORMAL, OFFSET)
        np.testing.assert_allclose(depth, truth, rtol=2e-5)
        expected = camera.cam_from_world[:, :3] @ -NORMAL
        np.testing.assert_allclose(normal, np.broadcast_to(expected, normal.shape), atol=1e-5)
        assert expected[2] < 0, "faces the camera"
    assert all(count <= total == len(job.views) for count, total in done)
    assert not (job.workspace / "stereo" / name.lower()).exists()


def test_only_the_region_and_what_is_not_masked(program: Path, job: MvsJob, tmp_path: Path) -> None:
    """A box around the middle of the plane; the left half of one image masked; one view that shares nothing."""
    job = replace(
        job,
        boxes_in_world=np.array([[[-0.5, -8.0, 2.0], [0.5, 8.0, 12.0]]]),
        mask_dir=tmp_path / "masks",
        sources=((1, 2), (0, 2), (0, 1), ()),
    )
    mask = np.full((160, 224), 255, np.uint8)
    mask[:, :112] = 0
    (tmp_path / "masks" / "cam").mkdir(parents=True)
    cv2.imwrite(str(tmp_path / "masks" / f"{job.views[1].name}.png"), mask)
    get_backend("acmp").estimate(job=job, options=MvsOptions(acmp_path=str(program)), num_threads=1)
    for view in (0, 1, 2):
        depth, normal = maps(job, view)
        camera = job.views[view]
        rays = np.stack([*np.meshgrid(np.arange(224) + 0.5, np.arange(160) + 0.5), np.ones((160, 224))], axis=-1)
        points = rays @ np.linalg.inv(camera.calibration).T * true_depth(camera, NORMAL, OFFSET)[..., None]
        x = ((points - camera.cam_from_world[:, 3]) @ camera.cam_from_world[:, :3])[..., 0]
        wanted = np.abs(x) <= 0.5
        if view == 1:
            wanted[:, :112] = False
        sure = np.abs(np.abs(x) - 0.5) > 1e-3
        np.testing.assert_array_equal((depth > 0)[sure], wanted[sure])
        assert 0 < wanted.sum() < wanted.size
        np.testing.assert_array_equal(np.linalg.norm(normal, axis=-1) > 0, depth > 0)
    assert not maps(job, 3)[0].any()


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("exit", "ACMP ended with exit code 1; its last lines: .*CUDA driver version is insufficient"),
        ("abort", "ACMP was ended by SIGABRT"),
        ("hang", "ACMP ran longer than 2 s and was stopped"),
        ("partial", "depths_geom.dmb was not written"),
        ("garbage", "is no map of 224x160 pixels with 1 channels"),
    ],
)
def test_faults_are_told_in_one_line(
    fault: str, message: str, program: Path, job: MvsJob, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FAULT", fault)
    options = MvsOptions(acmp_path=str(program), program_timeout_s=2 if fault == "hang" else 0)
    start = time.monotonic()
    with pytest.raises(MvsError, match=message) as caught:
        get_backend("acmp").estimate(job=job, options=options, num_threads=1)
    assert "\n" not in str(caught.value)
    assert time.monotonic() - start < 60
    monkeypatch.delenv("FAULT")
    get_backend("acmp").estimate(job=job, options=options, num_threads=1)
    assert all(maps(job, view)[0].all() for view in range(len(job.views)))


def test_a_missing_program_says_what_to_do(job: MvsJob, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    for given in ("", str(tmp_path), str(tmp_path / "nowhere")):
        availability = get_backend("acmmp").availability(MvsOptions(acmp_path=given))
        assert not availability.ok
        assert "ACMMP" in availability.reason and "--acmp-path" in availability.reason
    with pytest.raises(MvsError, match="no executable ACMMP"):
        get_backend("acmmp").estimate(job=job, options=MvsOptions(), num_threads=1)


def test_the_program_is_found_on_path(program: Path, job: MvsJob, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", f"{program}{os.pathsep}{os.environ['PATH']}")
    assert get_backend("acmh").availability(MvsOptions()).ok
    assert get_backend("acmh").availability(MvsOptions(acmp_path=str(program / "ACMH"))).ok


def test_images_too_large_for_acmp(tmp_path: Path, program: Path) -> None:
    job = plane_job(tmp_path / "large", normal=(0.0, 0.0, 1.0), size=(3202, 4), num_views=2)
    with pytest.raises(MvsError, match="--max-image-size-px 3200"):
        get_backend("acmp").estimate(job=job, options=MvsOptions(acmp_path=str(program)), num_threads=1)
