"""`full` on a small street: the cloud is where the street is, and a second run has nothing to do."""

from __future__ import annotations

import json
import shutil
import time
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray

from fusion.cloud import PointCloud, read_ply
from fusion.compare import CompareOptions, cloud_distances, mesh_distances
from tests.small_street import (
    CAMERAS,
    GPS_NOISE_M,
    HEIGHT,
    NUM_FRAMES,
    STREET,
    WIDTH,
    FinishedRun,
    center,
    cityrecon,
    true_poses,
)


@pytest.fixture(scope="module")
def centers(finished_run: FinishedRun) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Projection centres (N, 3) as found and as they are, of all registered images."""
    model = pycolmap.Reconstruction(finished_run.workspace / "georegister" / "model")
    poses = true_poses()
    images = [model.image(image_id) for image_id in model.reg_image_ids()]
    found = np.array([image.projection_center() for image in images])
    true = np.array([center(poses[image.name]) for image in images])
    return found, true


def rigid_fit(found: NDArray[np.float64], true: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotation (3, 3) and translation (3,), without scale, that bring points (N, 3) to others."""
    u, _, vt = np.linalg.svd((found - found.mean(axis=0)).T @ (true - true.mean(axis=0)))
    turn = (u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt).T
    return turn, true.mean(axis=0) - turn @ found.mean(axis=0)


@pytest.fixture(scope="module")
def cloud(finished_run: FinishedRun, centers: tuple[NDArray[np.float64], NDArray[np.float64]]) -> PointCloud:
    """The result in the frame of the ground truth."""
    turn, shift = rigid_fit(*centers)
    made = read_ply(finished_run.out)
    assert made.normals is not None
    points = (made.points @ turn.T + shift).astype(np.float32)
    return PointCloud(points, (made.normals @ turn.T).astype(np.float32), made.colors)


def test_all_images_are_where_they_were(centers: tuple[NDArray[np.float64], NDArray[np.float64]]) -> None:
    found, true = centers
    assert len(found) == 3 * NUM_FRAMES
    turn, shift = rigid_fit(found, true)
    errors_m = np.linalg.norm(found @ turn.T + shift - true, axis=1)
    assert np.median(errors_m) < 0.03, "shape and scale"
    assert np.degrees(np.arccos((np.trace(turn) - 1) / 2)) < 2.0, "x is east and z is up"
    offsets = found - true
    assert np.linalg.norm(offsets - offsets.mean(axis=0), axis=1).max() < 4 * GPS_NOISE_M


def test_the_georeference_names_the_true_place(
    finished_run: FinishedRun, centers: tuple[NDArray[np.float64], NDArray[np.float64]]
) -> None:
    georeference = json.loads((finished_run.workspace / "georegister" / "georeference.json").read_text())
    origin = json.loads((STREET / "truth.json").read_text())["origin_lat_lon_alt"]
    place = pycolmap.GPSTransform().ellipsoid_to_enu(np.array([georeference["origin_deg_m"]]), *origin)[0]
    found, true = centers
    assert np.linalg.norm((found + place - true).mean(axis=0)) < 4 * GPS_NOISE_M
    assert georeference["is_metric"]


def test_the_cloud_lies_on_the_street(cloud: PointCloud) -> None:
    """Half a pixel at 10 m is 2 cm here; a wrong scale of 1 % is 10 cm."""
    to_surface_m = mesh_distances(cloud.points, STREET / "gt_mesh.ply")
    assert np.median(to_surface_m) < 0.03
    assert np.mean(to_surface_m < 0.10) > 0.87
    truth = read_ply(STREET / "gt.ply")
    poses = true_poses()
    middle_m = np.mean([center(poses[f"{CAMERAS[0]}/{frame:06d}.jpg"]) for frame in range(NUM_FRAMES)], axis=0)
    near = np.linalg.norm(truth.points[:, :2] - middle_m[:2], axis=1) < 9.0
    assert np.mean(cloud_distances(truth.points[near], cloud.points) < 0.20) > 0.3, "there is a hole"


def test_normals_are_those_of_the_surface_and_face_the_cameras(cloud: PointCloud) -> None:
    assert cloud.normals is not None
    truth = read_ply(STREET / "gt.ply")
    assert truth.normals is not None
    rng = np.random.default_rng(0)
    picked = rng.choice(len(cloud), 400, replace=False)
    between = np.linalg.norm(cloud.points[picked, None] - truth.points[None, ::4], axis=2)
    nearest = between.argmin(axis=1)
    close = between.min(axis=1) < 0.3
    cosines = np.sum(cloud.normals[picked] * truth.normals[::4][nearest], axis=1)[close]
    assert close.sum() > 200
    assert np.median(cosines) > 0.95
    assert np.mean(cosines > 0) > 0.95
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1.0, atol=1e-3)


def test_colours_are_those_of_the_images(finished_run: FinishedRun, cloud: PointCloud) -> None:
    """Each point is compared with the images that may see it; the best one must agree closely in every channel."""
    assert cloud.colors is not None
    rig = json.loads((finished_run.scene / "rig.json").read_text())
    focal, _, cx, cy = rig[0]["cameras"][0]["camera_params"]
    smallest = np.full((len(cloud), 2), np.inf)
    for name, pose in true_poses().items():
        path = finished_run.scene / "images" / name
        if not path.exists():
            continue
        pixels = cv2.cvtColor(cv2.GaussianBlur(cv2.imread(str(path)), (3, 3), 0), cv2.COLOR_BGR2RGB)
        seen = cloud.points @ pose[:, :3].T + pose[:, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            uv = np.floor(focal * seen[:, :2] / seen[:, 2:] + (cx, cy))
        inside = (seen[:, 2] > 0.5) & (uv >= 0).all(axis=1) & (uv < (WIDTH, HEIGHT)).all(axis=1)
        u, v = uv[inside].astype(np.int64).T
        there = pixels[v, u].astype(np.float64)
        for column, order in enumerate(([0, 1, 2], [2, 1, 0])):
            difference = np.abs(there[:, order] - cloud.colors[inside]).max(axis=1)
            smallest[inside, column] = np.minimum(smallest[inside, column], difference)
    right, swapped = np.median(smallest, axis=0)
    assert right < 8
    assert swapped > 2 * right, "red and blue are told apart"


def test_reports_are_there(finished_run: FinishedRun) -> None:
    workspace = finished_run.workspace
    for name in (
        "config.toml",
        "cityrecon.log",
        "capture/inventory.json",
        "sfm/report.json",
        "clusters/report.json",
        "clusters/map.png",
        "selection/report.json",
        "compare/merged_against_batch.png",
    ):
        assert (workspace / name).stat().st_size > 0, name
    clusters = [json.loads(line)["cluster"] for line in (workspace / "selection" / "selection.jsonl").open()]
    assert {path.name for path in (workspace / "selection" / "pictures").iterdir()} == {f"{c}.svg" for c in clusters}
    report = json.loads((workspace / "sfm" / "report.json").read_text())
    assert report["registered"] == 3 * NUM_FRAMES
    assert not list(workspace.rglob("*.partial"))
    assert not list(finished_run.out.parent.glob(".*.partial"))


def test_merged_is_close_to_batch(finished_run: FinishedRun) -> None:
    text = (finished_run.workspace / "compare" / "merged_against_batch.json").read_text()
    comparison = json.loads(text)
    at_20_cm = next(score for score in comparison["scores"] if score["threshold_m"] == 0.2)
    assert at_20_cm["accuracy"] > 0.85
    assert at_20_cm["completeness"] > 0.6
    assert comparison["voxel_m"] == CompareOptions().voxel_m


def test_second_run_does_nothing_and_gives_the_same_bytes(finished_run: FinishedRun, tmp_path: Path) -> None:
    workspace = finished_run.copy_to(tmp_path)
    records = {path: path.stat().st_mtime_ns for path in workspace.rglob("record.json")}
    again = tmp_path / "again.ply"
    start = time.process_time()
    result = cityrecon(*finished_run.full(again, "--workspace", workspace))
    assert result.returncode == 0, result.stderr
    assert time.process_time() - start < 10
    assert again.read_bytes() == finished_run.out.read_bytes()
    assert {path: path.stat().st_mtime_ns for path in workspace.rglob("record.json")} == records
    assert "redoing" not in result.stderr


def test_moved_images_are_the_same_images(finished_run: FinishedRun, tmp_path: Path) -> None:
    """A workspace used with another folder says so; what is the same there isn't computed again."""
    workspace = finished_run.copy_to(tmp_path)
    moved = FinishedRun(tmp_path)
    shutil.copytree(finished_run.scene, moved.scene)
    result = cityrecon(*moved.full(tmp_path / "again.ply", "--workspace", workspace))
    assert result.returncode == 0, result.stderr
    redone = [line for line in result.stderr.splitlines() if "redoing" in line]
    assert len(redone) == 1
    assert redone[0].startswith("capture: redoing, because of")
    assert "changed images" in redone[0]
    assert (tmp_path / "again.ply").read_bytes() == finished_run.out.read_bytes()


def test_a_cluster_without_views_is_left_out(finished_run: FinishedRun, tmp_path: Path) -> None:
    workspace = finished_run.copy_to(tmp_path)
    shutil.rmtree(workspace / "jobs")
    selection = workspace / "selection" / "selection.jsonl"
    first, *others = (json.loads(line) for line in selection.read_text(encoding="utf-8").splitlines())
    lines = [json.dumps(record) for record in (first | {"image_names": []}, *others)]
    selection.write_text("\n".join(lines) + "\n", encoding="utf-8")
    result = cityrecon("fuse", workspace, "--out", tmp_path / "out.ply")
    assert result.returncode == 0, result.stderr
    assert f"from {len(others)} of {len(others)} clusters" in result.stderr
    assert 0 < (tmp_path / "out.ply").stat().st_size < finished_run.out.stat().st_size
