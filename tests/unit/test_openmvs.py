"""OpenMVS's adapter against programs that answer with the truth; OPENMVS may name the folder of the real ones."""

from __future__ import annotations

import os
import stat
import sys
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from mvs_backends import get_backend
from mvs_backends.base import MvsError, MvsJob, MvsOptions
from tests.reference.colmap_maps import read_map
from tests.reference.plane_scene import plane_job, true_depth

STAND_IN = Path(__file__).parents[1] / "stand_ins" / "openmvs.py"
NORMAL, OFFSET = np.array([0.4, 0.2, 1.0]) / np.linalg.norm([0.4, 0.2, 1.0]), 5.0


@pytest.fixture
def programs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> MvsOptions:
    folder = tmp_path / "bin"
    folder.mkdir()
    for name in ("InterfaceCOLMAP", "DensifyPointCloud"):
        executable = folder / name
        executable.write_text(f"#!{sys.executable}\n{STAND_IN.read_text(encoding='utf-8')}", encoding="utf-8")
        executable.chmod(executable.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PLANE", " ".join(map(str, [*NORMAL, OFFSET])))
    return MvsOptions(openmvs_path=str(folder))


@pytest.fixture
def job(tmp_path: Path) -> MvsJob:
    """With the model that OpenMVS reads, all views observing all points."""
    made = plane_job(tmp_path / "job", normal=(0.4, 0.2, 1.0), size=(224, 160), num_points=200)
    model = pycolmap.Reconstruction()
    for number, view in enumerate(made.views, start=1):
        k = view.calibration
        params = [k[0, 0], k[1, 1], k[0, 2], k[1, 2]]
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(camera_id=number, model="PINHOLE", width=view.width, height=view.height, params=params)
        )
        in_camera = made.points_in_world @ view.cam_from_world[:, :3].T + view.cam_from_world[:, 3]
        pixels = in_camera @ k.T
        image = pycolmap.Image(name=view.name, camera_id=number, image_id=number)
        image.points2D = [pycolmap.Point2D(xy) for xy in pixels[:, :2] / pixels[:, 2:]]
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(view.cam_from_world))
    for index, point in enumerate(made.points_in_world):
        track = pycolmap.Track()
        for number in range(1, len(made.views) + 1):
            track.add_element(number, index)
        model.add_point3D(point, track)
    (made.workspace / "sparse").mkdir()
    model.write_binary(made.workspace / "sparse")
    return made


def largest_errors(job: MvsJob, quantile: float) -> tuple[float, float, float]:
    """Of depth (relative), of the normal (cosine from 1), and the least share of pixels with a depth."""
    depths, normals, shares = [], [], []
    for view, camera in enumerate(job.views):
        depth, normal = read_map(job.depth_map_path(view)), read_map(job.normal_map_path(view))
        known = depth > 0
        shares.append(known.mean())
        depths.append(np.quantile(np.abs(depth / true_depth(camera, NORMAL, OFFSET) - 1)[known], quantile))
        normals.append(np.quantile(1 - normal[known] @ (camera.cam_from_world[:, :3] @ -NORMAL), quantile))
    return max(depths), max(normals), min(shares)


def test_maps_are_the_truth_whatever_their_order(programs: MvsOptions, job: MvsJob) -> None:
    get_backend("openmvs").estimate(job=job, options=programs, num_threads=1)
    depth, normal, share = largest_errors(job, 1.0)
    assert depth < 1e-5 and normal < 1e-5 and share == 1.0
    assert not (job.workspace / "stereo" / "openmvs").exists()


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("exit", "DensifyPointCloud ended with exit code 1; its last lines: .*cannot load the scene"),
        ("none", "DensifyPointCloud left no depth maps"),
        ("short", "can't be read"),
        ("pose", "was made with another pose"),
    ],
)
def test_faults_are_told_in_one_line(
    fault: str, message: str, programs: MvsOptions, job: MvsJob, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FAULT", fault)
    with pytest.raises(MvsError, match=message) as caught:
        get_backend("openmvs").estimate(job=job, options=programs, num_threads=1)
    assert "\n" not in str(caught.value)
    monkeypatch.delenv("FAULT")
    get_backend("openmvs").estimate(job=job, options=programs, num_threads=1)
    assert largest_errors(job, 1.0)[2] == 1.0


def test_missing_programs(job: MvsJob, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    availability = get_backend("openmvs").availability(MvsOptions())
    assert not availability.ok and "--openmvs-path" in availability.reason
    with pytest.raises(MvsError, match="no executable InterfaceCOLMAP and DensifyPointCloud"):
        get_backend("openmvs").estimate(job=job, options=MvsOptions(), num_threads=1)


@pytest.mark.skipif("OPENMVS" not in os.environ, reason="OPENMVS names no folder with OpenMVS's programs")
def test_the_real_programs(job: MvsJob) -> None:
    get_backend("openmvs").estimate(job=job, options=MvsOptions(openmvs_path=os.environ["OPENMVS"]), num_threads=2)
    depth, normal, share = largest_errors(job, 0.9)
    assert depth < 0.01 and normal < 0.05 and share > 0.5
