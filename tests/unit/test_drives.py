"""Simulated drives: a model that COLMAP opens, tracks of images that see their points, keyframes while moving."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from app.scene.posed_scene import PosedScene
from app.scene.read_model import read_posed_scene
from benchmarks.drives.district import District, drive_route, make_district, path_of
from benchmarks.drives.kernels import is_hidden, observe
from benchmarks.drives.presets import PRESETS
from benchmarks.drives.vehicle import FRAME_RATE_HZ, IMAGE_SIZE_PX, drive
from benchmarks.drives.write_drive import write_drive
from tests.reference import drives as plain

SMALL = PRESETS["small"]
TWO_DISTRICTS = replace(SMALL, num_districts=2, num_points=1_500, num_keyframes=40)


@pytest.fixture(scope="module")
def model_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("drive")
    write_drive(TWO_DISTRICTS, folder)
    return folder


@pytest.fixture(scope="module")
def scene(model_dir: Path) -> PosedScene:
    return read_posed_scene(model_dir)


def test_colmap_opens_the_model_and_its_observations_fit(model_dir: Path) -> None:
    model = pycolmap.Reconstruction(str(model_dir))

    assert (model.num_images(), model.num_points3D()) == (2 * 40 * 7, 2 * 1_500)
    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() == pytest.approx(0.5 * np.sqrt(np.pi / 2), abs=0.02)
    for image in model.images.values():
        for index in range(image.num_points2D()):
            point_id = image.points2D[index].point3D_id
            if point_id != pycolmap.INVALID_POINT3D_ID:
                elements = {(e.image_id, e.point2D_idx) for e in model.points3D[point_id].track.elements}
                assert (image.image_id, index) in elements


def test_image_names_sort_by_camera_and_time(scene: PosedScene) -> None:
    assert scene.image_names[0] == "front/000_000000.jpg"
    assert len(scene.image_names) == 2 * 40 * 7
    assert {name.split("/")[0] for name in scene.image_names} == {
        "front", "front_left", "front_right", "left", "right", "rear_left", "rear_right"
    }  # fmt: skip


def test_cameras_look_all_round_and_stand_upright(scene: PosedScene) -> None:
    yaws = np.degrees(np.arctan2(scene.cam_from_world[:, 2, 1], scene.cam_from_world[:, 2, 0])) % 360

    assert np.all(scene.cam_from_world[:, 1, 2] < -0.99)
    assert np.histogram(yaws, bins=8, range=(0, 360))[0].min() > 0


def test_the_same_preset_gives_the_same_bytes(model_dir: Path, tmp_path: Path) -> None:
    write_drive(TWO_DISTRICTS, tmp_path)

    for path in sorted(model_dir.iterdir()):
        assert path.read_bytes() == (tmp_path / path.name).read_bytes(), path.name


def test_keyframes_are_evenly_spaced_and_never_taken_while_standing() -> None:
    rng = np.random.default_rng(3)
    district = make_district(3, 75.0, 0.85, rng)
    keyframes = drive(path_of(district, drive_route(district, 400.0, rng)), 200, 2.0, rng)

    steps = np.linalg.norm(np.diff(keyframes.centers_m, axis=0), axis=1)
    seconds = np.diff(keyframes.frame_numbers) / FRAME_RATE_HZ
    # A frame later than wanted by up to 1/30 s at 14 m/s; shorter where the vehicle turns.
    assert steps.max() < 2.5 and steps.min() > 1.3
    assert seconds.max() > 3.0 and np.median(seconds) < 0.5


def test_a_roundabout_is_driven_counterclockwise_around_its_middle() -> None:
    district = make_district(3, 75.0, 0.85, np.random.default_rng(0))
    i, j = district.roundabout
    center = np.array([district.lines_m[0][i], district.lines_m[1][j]])
    path = path_of(district, [(i - 1, j), (i, j), (i + 1, j)]) - center

    near = path[np.linalg.norm(path, axis=1) < 12.0]
    angles = np.unwrap(np.arctan2(near[:, 1], near[:, 0]))
    assert np.linalg.norm(near, axis=1).min() > 6.0
    assert np.all(np.diff(angles) > 0) and angles[-1] - angles[0] > 2.0


def test_some_streets_are_driven_several_times() -> None:
    rng = np.random.default_rng(1)
    district = make_district(4, 75.0, 0.85, rng)
    route = drive_route(district, 3_000.0, rng)

    streets = [tuple(sorted(pair)) for pair in zip(route, route[1:], strict=False)]
    assert len(set(streets)) < len(streets)
    assert all(a != c for a, c in zip(route, route[2:], strict=False)), "no turning back on the spot"


def test_hidden_by_a_house_is_what_many_samples_say() -> None:
    rng = np.random.default_rng(2)
    houses = np.sort(rng.uniform(0.0, 10.0, (5, 2, 2)), axis=1).reshape(5, 4)
    ends = rng.uniform(0.0, 10.0, (300, 2, 2))
    found = [is_hidden(a, b, houses) for a, b in ends]

    assert found == [plain.is_hidden(a, b, houses) for a, b in ends]
    assert 50 < sum(found) < 290
    assert is_hidden(np.array([5.0, 0.0]), np.array([5.0, 10.0]), np.array([[4.0, 4.0, 6.0, 6.0]]))
    assert not is_hidden(np.array([5.0, 0.0]), np.array([5.0, 3.0]), np.array([[4.0, 4.0, 6.0, 6.0]]))


def test_tracks_are_those_of_the_plain_twin() -> None:
    rng = np.random.default_rng(4)
    district: District = make_district(3, 60.0, 0.85, rng)
    keyframes = drive(path_of(district, drive_route(district, 100.0, rng)), 50, 2.0, rng)
    points = keyframes.centers_m[rng.integers(0, 50, 150)] + rng.normal(0.0, 8.0, (150, 3))
    normals = rng.normal(size=(150, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    reach, chances = rng.uniform(5.0, 40.0, 150), rng.random((150, 3))
    size, houses = np.array(IMAGE_SIZE_PX, dtype=np.float64), district.houses()
    ranges = np.tile([0, 50], (150, 1))
    images, pixels, lengths = observe(
        points, normals, reach, chances, np.arange(50), ranges, keyframes.centers_m, keyframes.image_from_district,
        size, houses, 0.6, 4.0, 48,
    )  # fmt: skip

    assert (lengths > 1).sum() > 20
    for p in range(150):
        expected = plain.observe(
            points[p], normals[p], reach[p], chances[p], keyframes.centers_m, keyframes.image_from_district,
            size, houses, 0.6, 4.0,
        )  # fmt: skip
        assert set(images[p, : lengths[p]].tolist()) == expected
        for image, pixel in zip(images[p, : lengths[p]], pixels[p], strict=False):
            matrix = keyframes.image_from_district.reshape(-1, 3, 4)[image]
            x, y, z = matrix @ np.append(points[p], 1.0)
            np.testing.assert_allclose(pixel, (x / z, y / z), rtol=1e-5, atol=1e-2)
