"""The rendered street: its ground truth is exact, and its files agree with one another."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from fusion.cloud import read_ply
from fusion.compare import mesh_distances
from sample_data.render_street import ORIGIN_LAT_LON_ALT, StreetOptions, StreetTruth, build_street, render_street
from sample_data.street_path import PathKind, plan_roads

pytestmark = pytest.mark.usefixtures("open3d")

SAMPLE = Path(__file__).parents[2] / "sample_data" / "street"
SMALL = StreetOptions(seed=3, n_frames=3, width=96, height=60, truth_voxel_m=0.3)


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, StreetTruth]:
    folder = tmp_path_factory.mktemp("street")
    return folder, render_street(folder, SMALL, with_depth=True)


def test_the_same_seed_gives_the_same_bytes(street: tuple[Path, StreetTruth], tmp_path: Path) -> None:
    folder, _ = street
    render_street(tmp_path, SMALL, with_depth=True)
    names = sorted(path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    assert names == sorted(path.relative_to(tmp_path) for path in tmp_path.rglob("*") if path.is_file())
    assert len(names) == 9 + 9 + 7
    for name in names:
        assert (folder / name).read_bytes() == (tmp_path / name).read_bytes(), name


def test_depth_maps_lie_on_the_mesh(street: tuple[Path, StreetTruth]) -> None:
    folder, truth = street
    for name, pose in truth.images():
        depth = np.load((folder / "depth" / name).with_suffix(".npy"))
        assert depth.shape == (60, 96)
        near = (depth > 0) & (depth < 60)
        assert near.mean() > 0.5
        in_camera = (depth[..., None] * truth.camera.rays())[near]
        world = ((in_camera - pose.translation) @ pose.rotation).astype(np.float32)
        assert mesh_distances(world, folder / "gt_mesh.ply").max() < 1e-3


@pytest.mark.parametrize("supersampling", [1, 2])
def test_rays_go_through_pixel_centres(supersampling: int) -> None:
    camera = SMALL.camera
    colmap_camera = pycolmap.Camera(model="PINHOLE", width=96, height=60, params=camera.params)
    rays = camera.rays(supersampling).astype(np.float64)
    pixels = colmap_camera.img_from_cam(rays.reshape(-1, 3)).reshape(60 * supersampling, 96 * supersampling, 2)
    whole = pixels.reshape(60, supersampling, 96, supersampling, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(whole[..., 0], np.tile(np.arange(96) + 0.5, (60, 1)), atol=1e-4)
    np.testing.assert_allclose(whole[..., 1], np.tile(np.arange(60)[:, None] + 0.5, (1, 96)), atol=1e-4)


def test_the_cloud_lies_on_the_mesh_with_normals_towards_a_camera(street: tuple[Path, StreetTruth]) -> None:
    folder, truth = street
    cloud = read_ply(folder / "gt.ply")
    assert len(cloud) > 1000
    assert mesh_distances(cloud.points, folder / "gt_mesh.ply").max() < 1e-3
    assert cloud.normals is not None
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1, atol=1e-4)
    centers = np.stack([pose.center for _, pose in truth.images()])
    facing = np.einsum("nk,cnk->cn", cloud.normals, centers[:, None] - cloud.points[None])
    assert (facing > 0).any(axis=0).all()


@pytest.mark.parametrize("n_cameras", [1, 2, 3, 6, 8])
def test_rig_and_poses_agree(tmp_path: Path, n_cameras: int) -> None:
    options = StreetOptions(seed=3, n_frames=2, width=32, height=20, n_cameras=n_cameras)
    render_street(tmp_path, options, with_cloud=False)
    poses = {entry["image"]: entry for entry in json.loads((tmp_path / "poses_gt.json").read_text())}
    (rig,) = pycolmap.read_rig_config(tmp_path / "rig.json")
    assert len(rig.cameras) == n_cameras
    assert len(poses) == 2 * n_cameras
    for index, entry in enumerate(rig.cameras):
        assert entry.ref_sensor == (index == 0)
        cam_from_rig = np.eye(4)[:3] if entry.ref_sensor else entry.cam_from_rig.matrix()
        for frame in ("000000.jpg", "000001.jpg"):
            rig_pose, pose = poses[f"cam0/{frame}"], poses[f"{entry.image_prefix}{frame}"]
            np.testing.assert_allclose(cam_from_rig[:, :3] @ rig_pose["R"], pose["R"], atol=1e-6)
            np.testing.assert_allclose(cam_from_rig[:, :3] @ rig_pose["t"] + cam_from_rig[:, 3], pose["t"], atol=1e-5)
            np.testing.assert_allclose(-np.array(pose["R"]).T @ pose["t"], pose["C"], atol=1e-5)


@pytest.mark.parametrize("kind", list(PathKind))
def test_the_drive_is_smooth_and_stays_on_the_road(kind: PathKind) -> None:
    truth = build_street(StreetOptions(seed=3, path=kind, n_frames=80, frame_spacing_m=1.0, n_cameras=1))
    centers = np.stack([pose.center for pose in truth.rigs_from_world])
    np.testing.assert_allclose(np.linalg.norm(np.diff(centers[:, :2], axis=0), axis=1), 1.0, atol=0.02)
    headings = np.unwrap([np.arctan2(pose.rotation[2, 1], pose.rotation[2, 0]) for pose in truth.rigs_from_world])
    assert np.abs(np.diff(headings)).max() < 0.13
    assert truth.town.field.sample(centers[:, :2])[:, 0].max() < -1.0
    rays = np.array([[0, 0, 1.0]], dtype=np.float32)
    ahead = [truth.renderer.cast(pose, rays)["depth"][0] for pose in truth.rigs_from_world]
    assert min(ahead) > 3.0


@pytest.mark.parametrize("kind", list(PathKind))
def test_a_drive_can_be_named_by_a_plain_word(kind: PathKind) -> None:
    options = StreetOptions(path=str(kind))  # type: ignore[arg-type]
    of_word, of_kind = (plan_roads(path, 200.0).path for path in (options.path, kind))
    np.testing.assert_array_equal(of_word.points, of_kind.points)


def test_an_unknown_drive_is_refused() -> None:
    with pytest.raises(ValueError, match="straight, corner, loop, roundabout, not 'square'"):
        StreetOptions(path="square")  # type: ignore[arg-type]


def test_a_loop_closes() -> None:
    path = plan_roads(PathKind.LOOP, 200.0).path
    (start, after_a_lap), headings = path.at(np.array([0.0, 0.93 * 200]))
    np.testing.assert_allclose(after_a_lap, start, atol=0.01)
    assert headings[1] - headings[0] == pytest.approx(2 * np.pi, abs=0.02)


def test_poor_texture_makes_plain_walls_and_road() -> None:
    rich, poor = (
        build_street(StreetOptions(seed=3, n_frames=2, n_cameras=1, width=320, height=200, richness=value))
        for value in (1.0, 0.0)
    )
    assert 0.12 < rich.town.plain_share < 0.25
    assert poor.town.plain_share > 0.6
    sharpness = []
    for truth in (rich, poor):
        ((_, pose), *_) = truth.images()
        road = truth.renderer.image(truth.camera, pose)[160:, 100:220]
        sharpness.append(float(np.abs(cv2.Laplacian(road, cv2.CV_32F)).mean()))
    assert sharpness[0] > 4 * sharpness[1]


def test_the_sample_is_complete_and_true() -> None:
    """The committed sample: positions, colours and features fit the ground truth."""
    names = [f"cam{camera}/{frame:06d}.jpg" for camera in range(3) for frame in range(20)]
    poses = {entry["image"]: entry for entry in json.loads((SAMPLE / "poses_gt.json").read_text())}
    assert sorted(poses) == names
    assert sorted(path.relative_to(SAMPLE / "images").as_posix() for path in SAMPLE.rglob("*.jpg")) == names
    assert sum(path.stat().st_size for path in SAMPLE.rglob("*")) < 10_000_000
    fixes = np.loadtxt(SAMPLE / "gps.csv", delimiter=",", skiprows=1)
    transform = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    offset = transform.ellipsoid_to_enu(fixes[:, 1:], *ORIGIN_LAT_LON_ALT) - np.array(
        [poses[f"cam0/{frame:06d}.jpg"]["C"] for frame in range(20)]
    )
    assert 0.1 < offset.std() < 0.6
    sift = cv2.SIFT_create(contrastThreshold=0.02)
    counts = [len(sift.detect(cv2.imread(str(SAMPLE / "images" / name)), None)) for name in names[::7]]
    assert min(counts) > 1000


def test_a_surface_point_has_one_colour_in_two_images() -> None:
    cloud = read_ply(SAMPLE / "gt.ply")
    poses = {entry["image"]: entry for entry in json.loads((SAMPLE / "poses_gt.json").read_text())}
    focal = json.loads((SAMPLE / "truth.json").read_text())["camera"]["params"][0]
    on_road = cloud.select(np.abs(cloud.points[:, 2]) < 1e-3)
    colors, seen = [], []
    for name in ("cam0/000004.jpg", "cam0/000006.jpg"):
        rotation, translation = np.array(poses[name]["R"]), np.array(poses[name]["t"])
        x, y, z = (on_road.points @ rotation.T + translation).T
        column, row = np.floor(focal * x / z + 320).astype(int), np.floor(focal * y / z + 200).astype(int)
        inside = (z > 2) & (z < 9) & (column >= 0) & (column < 640) & (row >= 0) & (row < 400)
        image = cv2.imread(str(SAMPLE / "images" / name), cv2.IMREAD_GRAYSCALE).astype(float)
        colors.append(np.where(inside, image[np.clip(row, 0, 399), np.clip(column, 0, 639)], 0))
        seen.append(inside)
    both = seen[0] & seen[1]
    assert both.sum() > 500
    assert np.corrcoef(colors[0][both], colors[1][both])[0, 1] > 0.8
