"""The sky is found, and what only looks like it is left alone.

world z up; the camera looks along world x, level, so the horizon is the middle row:

    row 0    ┌──────────────┐
             │ sky  │ wall  │   the wall: as plain and bright as the sky
    horizon  ├──────┴───────┤
             │     road     │
             └──────────────┘
"""

import json
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray

from app.sky import MAX_RED_OVER_BLUE, find_sky, redness_limit, redness_of_sky
from benchmarks.dense_workspace import make_workspace
from mvs_backends.masks import read_mask
from tests.small_street import STREET

K = np.array([[200.0, 0, 160], [0, 200, 100], [0, 0, 1]])
CAM_FROM_WORLD = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0]])


def picture() -> NDArray[np.uint8]:
    image = np.full((200, 320, 3), (230, 200, 180), np.uint8)
    image[100:] = (80, 80, 80)
    image[:, 158:162] = (20, 20, 20)
    return image


def sky_of(image: NDArray[np.uint8], keypoints: list[tuple[float, float]]) -> NDArray[np.bool_]:
    return find_sky(
        image,
        calibration=K,
        cam_from_world=CAM_FROM_WORLD,
        keypoints_px=np.array(keypoints, dtype=np.float64).reshape(-1, 2),
    )


def test_bright_plain_area_above_the_horizon_is_sky() -> None:
    sky = sky_of(picture(), [])
    assert sky[:95, :150].all()
    assert not sky[110:].any()


def test_an_area_with_keypoints_is_a_wall() -> None:
    wall = [(x, y) for x in np.linspace(180, 300, 5) for y in np.linspace(10, 80, 3)]
    sky = sky_of(picture(), wall)
    assert sky[:95, :150].all()
    assert not sky[:, 175:].any()


def test_keypoints_of_a_roof_along_its_edge_do_not_make_the_sky_a_wall() -> None:
    roof = [(x, 95.0) for x in np.linspace(5, 150, 40)]
    assert sky_of(picture(), roof)[:95, :150].all()


def test_a_line_that_undistortion_leaves_black_is_not_the_end_of_the_sky() -> None:
    lined = picture()
    lined[:1] = lined[-1:] = 0
    assert sky_of(lined, [])[10:95, :150].all()


def test_a_deep_blue_sky_is_darker_than_the_houses() -> None:
    image = picture()
    image[:100, :158] = (150, 90, 50)
    image[:100, 162:] = (200, 210, 255)
    sky = sky_of(image, [])
    assert sky[:95, :150].all()
    assert not sky[:, 175:].any()


def test_the_sun_does_not_make_the_rest_of_the_sky_too_dark() -> None:
    image = picture()
    image[:100, :158] = (150, 130, 120)
    image[30:80, 20:80] = 255
    image[:100, 162:] = (95, 90, 85)
    sky = sky_of(image, [])
    assert sky[:95, 90:150].all()
    assert not sky[:, 175:].any(), "a wall in the shade, not much brighter than the road"


def test_a_sky_that_is_reddish_in_all_images() -> None:
    dusk = np.ascontiguousarray(picture()[:, :, ::-1])
    allowed = find_sky(
        dusk, calibration=K, cam_from_world=CAM_FROM_WORLD, keypoints_px=np.empty((0, 2)), max_red_over_blue=255
    )
    assert redness_of_sky(dusk, allowed) == 50
    assert np.isnan(redness_of_sky(dusk, np.zeros_like(allowed)))
    none = float("nan")
    assert 50 < redness_limit([50.0, 48.0, 52.0, 50.0, none, 51.0, 49.0]) < 75
    for other in ([50.0] * 4, [50.0] * 5 + [0.0] * 2, [50.0] * 5 + [none] * 6, [20.0, 40, 60, 80, 100, 120], []):
        assert redness_limit(other) == MAX_RED_OVER_BLUE


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_the_upper_border_of_a_camera_held_upright(turns: int) -> None:
    """The picture turned counterclockwise, as a camera stores it that was turned clockwise."""
    pose, calibration = CAM_FROM_WORLD, K
    for width in (320, 200, 320)[:turns]:
        pose = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]) @ pose
        calibration = np.array([[200.0, 0, calibration[1, 2]], [0, 200, width - calibration[0, 2]], [0, 0, 1]])
    image = np.ascontiguousarray(np.rot90(picture(), turns))
    sky = find_sky(image, calibration=calibration, cam_from_world=pose, keypoints_px=np.empty((0, 2)))
    np.testing.assert_array_equal(np.rot90(sky, -turns), sky_of(picture(), []))


def test_what_is_below_the_horizon_or_away_from_the_border_or_reddish_is_not_sky() -> None:
    upside_down = np.array([[0.0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0]])
    assert not find_sky(picture(), calibration=K, cam_from_world=upside_down, keypoints_px=np.empty((0, 2)))[:90].any()
    framed = picture()
    framed[:20] = (20, 20, 20)
    assert not sky_of(framed, []).any()
    assert not sky_of(np.ascontiguousarray(picture()[:, :, ::-1]), []).any()


@pytest.mark.parametrize("name", ["cam0/000003.jpg", "cam1/000012.jpg", "cam2/000017.jpg", "cam0/000019.jpg"])
def test_sky_of_the_sample_is_where_rays_miss_the_town(open3d, name: str) -> None:  # type: ignore[no-untyped-def]
    pose = next(
        entry for entry in json.loads((STREET / "poses_gt.json").read_text(encoding="utf-8")) if entry["image"] == name
    )
    params = json.loads((STREET / "truth.json").read_text(encoding="utf-8"))["camera"]["params"]
    calibration = np.array([[params[0], 0, params[2]], [0, params[1], params[3]], [0, 0, 1]])
    rotation = np.array(pose["R"])
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(open3d.t.io.read_triangle_mesh(str(STREET / "gt_mesh.ply")))
    v, u = np.mgrid[0:400, 0:640] + 0.5
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(calibration).T @ rotation
    origins = np.broadcast_to(np.array(pose["C"]), rays.shape)
    cast = scene.cast_rays(open3d.core.Tensor.from_numpy(np.concatenate([origins, rays], -1).astype(np.float32)))
    truth = ~np.isfinite(cast["t_hit"].numpy())
    image = np.asarray(cv2.imread(str(STREET / "images" / name)), dtype=np.uint8)
    found = find_sky(
        image,
        calibration=calibration,
        cam_from_world=np.column_stack([rotation, pose["t"]]),
        keypoints_px=np.empty((0, 2)),
    )
    border = cv2.dilate(truth.astype(np.uint8), np.ones((13, 13), np.uint8)).astype(bool)
    assert not (found & ~border).any(), "nothing of the town is taken for sky"
    assert truth.sum() < 500 or (found & truth).sum() > 0.9 * truth.sum()


@pytest.mark.parametrize("share_of_dusk", [1.0, 0.5])
def test_masks_of_a_cluster_know_its_sky(tmp_path: Path, share_of_dusk: float) -> None:
    """Reddish areas are the sky where all images have them, and walls beside a sky that is blue in the others."""
    model, num_images = pycolmap.Reconstruction(), 6
    camera = pycolmap.Camera(camera_id=1, model="PINHOLE", width=320, height=200, params=[200, 200, 160, 100])
    model.add_camera_with_trivial_rig(camera)
    ground = np.array([[x, y, z] for x in (6.0, 14.0) for y in (-3.0, 0, 3) for z in (-2.5, -1.0)])
    for i in range(num_images):
        dusk = i < share_of_dusk * num_images
        cv2.imwrite(str(tmp_path / f"{i}.png"), np.ascontiguousarray(picture()[:, :, :: -1 if dusk else 1]))
        pose = pycolmap.Rigid3d(CAM_FROM_WORLD)
        seen = ground @ CAM_FROM_WORLD[:, :3].T
        pixels = 200 * seen[:, :2] / seen[:, 2:] + [160, 100]
        image = pycolmap.Image(name=f"{i}.png", keypoints=pixels, camera_id=1, image_id=i + 1)
        model.add_image_with_trivial_frame(image, pose)
    for index, point in enumerate(ground):
        track = pycolmap.Track([pycolmap.TrackElement(i + 1, index) for i in range(num_images)])
        model.add_point3D(point, track, np.zeros(3, np.uint8))
    (tmp_path / "model").mkdir()
    model.write_binary(str(tmp_path / "model"))
    job = make_workspace(tmp_path / "work", model=tmp_path / "model", images=tmp_path, frames=range(num_images))
    masked = [not read_mask(job, view, 320, 200)[20:80, 20:140].any() for view in range(num_images)]
    assert masked == [share_of_dusk == 1.0 or i >= 3 for i in range(num_images)]
