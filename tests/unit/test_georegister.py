"""Known similarities are found again: with noise, outliers, on straight roads, and without GPS."""

import json
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray

from app.capture.inventory import Inventory
from app.errors import InputError
from app.georegister.alignment import fit_planar
from app.georegister.georeference import Georeference, GravitySource, ScaleSource
from app.georegister.georegister import georegister
from app.georegister.gravity import up_from_cameras
from app.georegister.options import GeoregisterOptions
from tests.street_model import (
    HEIGHT_M,
    ORIGIN,
    Drive,
    drive,
    inventory,
    on_a_slope,
    random_similarity,
    write_model,
)


def run(
    tmp_path: Path,
    truth: Drive,
    captured: Inventory | None,
    *,
    seed: int = 1,
    similarity: pycolmap.Sim3d | None = None,
    **options: float | bool,
) -> tuple[Georeference, pycolmap.Reconstruction]:
    write_model(truth, tmp_path / "sfm", similarity or random_similarity(seed))
    found = georegister(
        tmp_path / "sfm",
        captured,
        tmp_path / "georegister",
        options=GeoregisterOptions(**options),  # type: ignore[arg-type]
    )
    assert Georeference.read(tmp_path / "georegister" / "georeference.json") == found
    return found, pycolmap.Reconstruction(tmp_path / "georegister" / "model")


def rotation_error(truth: Drive, model: pycolmap.Reconstruction) -> NDArray[np.float64]:
    """(3, 3) found world from true world."""
    image = model.find_image_with_name("cam0/000000.jpg")
    found: NDArray[np.float64] = image.cam_from_world().rotation.matrix().T @ truth.rotations[0, 0]
    return found


def tilt_deg(truth: Drive, model: pycolmap.Reconstruction) -> float:
    return float(np.degrees(np.arccos(np.clip(rotation_error(truth, model)[2, 2], -1.0, 1.0))))


def errors_m(truth: Drive, model: pycolmap.Reconstruction, found: Georeference) -> NDArray[np.float64]:
    """(F,) distances of cam0 from the truth, both in ENU of ORIGIN."""
    assert found.origin_deg_m is not None
    gps = pycolmap.GPSTransform()
    centers = np.array(
        [
            model.find_image_with_name(f"cam0/{frame:06d}.jpg").projection_center()
            for frame in range(len(truth.centers_m))
        ]
    )
    geodetic = gps.enu_to_ellipsoid(centers, *found.origin_deg_m)
    return np.linalg.norm(gps.ellipsoid_to_enu(geodetic, *ORIGIN) - truth.centers_m[:, 0], axis=1)


def noisy(truth: Drive, sigma_m: float, seed: int = 0) -> NDArray[np.float64]:
    noise = np.random.default_rng(seed).normal(0.0, sigma_m, (len(truth.centers_m), 3))
    return truth.centers_m[:, 0] + noise * (1.0, 1.0, 1.5)


def test_exact_gps_gives_the_truth(tmp_path: Path) -> None:
    truth = drive()
    found, model = run(tmp_path, truth, inventory(truth, gps_m=truth.centers_m[:, 0]))
    assert found.is_metric and found.scale_source is ScaleSource.GPS
    assert found.residuals is not None and found.residuals.antenna_m is None
    assert errors_m(truth, model, found).max() < 0.03
    assert tilt_deg(truth, model) < 0.1
    assert found.camera_height == pytest.approx(HEIGHT_M, rel=0.02)
    assert found.gravity_sigma_deg < 1.5


def test_noise_and_a_fifth_of_outliers(tmp_path: Path) -> None:
    truth = drive(40)
    gps = noisy(truth, 0.3)
    wrong = np.random.default_rng(5).permutation(40)[:8]
    gps[wrong] += (30.0, -20.0, 15.0)
    found, model = run(tmp_path, truth, inventory(truth, gps_m=gps))
    assert found.residuals is not None
    assert 28 <= found.residuals.num_inliers <= 32 and found.residuals.num_frames == 40
    assert {int(name) for name in found.outlier_frames} >= set(wrong.tolist())
    assert 0.2 < found.residuals.horizontal_rms_m < 0.6
    assert np.median(errors_m(truth, model, found)) < 0.3
    assert tilt_deg(truth, model) < 0.7
    factor = np.cbrt(np.linalg.det(np.array(found.world_from_model).reshape(3, 4)[:, :3]))
    assert factor == pytest.approx(1.0 / 0.137, rel=0.02)


@pytest.mark.parametrize(("num_wrong", "warned"), [(4, False), (16, True)])
def test_says_when_gps_and_model_disagree(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, num_wrong: int, warned: bool
) -> None:
    truth = drive(40)
    gps = noisy(truth, 0.3)
    gps[:num_wrong] += np.random.default_rng(2).normal(0.0, 20.0, (num_wrong, 3))
    run(tmp_path, truth, inventory(truth, gps_m=gps))
    assert ("GPS positions fit the model" in caplog.text) == warned


@pytest.mark.parametrize(("num_frames", "most"), [(5, 4), (8, 8)])
def test_a_short_drive_keeps_its_good_positions(num_frames: int, most: int) -> None:
    """Two positions fit a similarity exactly; that must not make the noise look smaller than it is."""
    path = np.array([[1.4 * i, 0.04 * i * i] for i in range(num_frames)])
    rng = np.random.default_rng(0)
    outliers = 0
    for _ in range(50):
        fit = fit_planar(path, path + rng.normal(0.0, 0.1, path.shape), seed=0)
        assert fit is not None
        outliers += int((~fit.inliers).sum())
    assert outliers <= most


@pytest.mark.parametrize(("sigma_m", "num_frames"), [(0.3, 15), (4.5, 60)])
def test_a_straight_drive_comes_out_level(tmp_path: Path, sigma_m: float, num_frames: int) -> None:
    """GPS says nothing about the roll about a straight path, and little about its pitch."""
    truth = drive(num_frames, corner=False, pitch_deg=8.0)
    for seed in range(3):
        found, model = run(tmp_path, truth, inventory(truth, gps_m=noisy(truth, sigma_m, seed)), seed=seed)
        assert tilt_deg(truth, model) < 1.2
        assert found.crs.startswith("ENU") and found.is_metric


def test_positions_without_heights(tmp_path: Path) -> None:
    truth = drive()
    captured = inventory(truth, gps_m=noisy(truth, 0.1))
    flat = [replace(f, gps=(f.gps[0], f.gps[1], float("nan"))) for f in captured.frames if f.gps]
    found, model = run(tmp_path, truth, replace(captured, frames=tuple(flat)))
    assert found.residuals is not None and found.residuals.vertical_rms_m is None
    assert found.origin_deg_m is not None and found.origin_deg_m[2] == 0.0
    assert tilt_deg(truth, model) < 1.0


def test_an_antenna_beside_the_camera(tmp_path: Path) -> None:
    truth = drive(30)
    heading = np.where(np.arange(30)[:, None] < 15, (1.0, 0.0), (0.0, 1.0))
    right = np.column_stack((heading[:, 1], -heading[:, 0]))
    gps = noisy(truth, 0.02)
    gps[:, :2] += -1.2 * heading + 0.4 * right
    found, model = run(tmp_path, truth, inventory(truth, gps_m=gps))
    assert found.residuals is not None and found.residuals.antenna_m == pytest.approx((0.4, -1.2), abs=0.1)
    assert np.median(errors_m(truth, model, found)) < 0.1


def test_missing_images_do_not_move_frames(tmp_path: Path) -> None:
    truth = drive()
    write_model(truth, tmp_path / "whole", random_similarity(1))
    model = pycolmap.Reconstruction(tmp_path / "whole")
    for frame in range(20):
        model.deregister_frame(model.find_image_with_name(f"cam{frame % 3}/{frame:06d}.jpg").frame_id)
    (tmp_path / "part").mkdir()
    model.write_binary(tmp_path / "part")
    found = georegister(
        tmp_path / "part",
        inventory(truth, gps_m=truth.centers_m[:, 0]),
        tmp_path / "out",
        options=GeoregisterOptions(),
    )
    assert found.residuals is not None
    assert found.residuals.num_frames == 20 and found.residuals.horizontal_max_m < 0.02


@pytest.mark.parametrize("corner", [False, True])
@pytest.mark.parametrize("seed", [1, 2])
def test_gravity_from_cameras_and_ground(
    tmp_path: Path, corner: bool, seed: int, caplog: pytest.LogCaptureFixture
) -> None:
    truth = drive(corner=corner, pitch_deg=10.0, seed=seed)
    found, model = run(tmp_path, truth, inventory(truth), seed=seed)
    assert tilt_deg(truth, model) < 1.0
    assert found.gravity_source is GravitySource.CAMERAS_AND_GROUND
    assert not found.is_metric and found.scale_source is ScaleSource.NONE and found.crs == "local"
    assert caplog.text.count("the model is unscaled") == 1
    centers = [model.find_image_with_name(f"cam0/{frame:06d}.jpg").projection_center() for frame in range(20)]
    spacing = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    assert np.median(spacing) == pytest.approx(1.0)
    assert np.allclose(centers[0][:2], 0.0, atol=1e-3)
    assert centers[0][2] == pytest.approx(HEIGHT_M / 1.5, rel=0.03)


def test_cameras_that_look_around_tell_up_without_the_ground() -> None:
    """All look 10 degrees down; what is horizontal are their x axes."""
    truth = drive(pitch_deg=10.0)
    found = up_from_cameras(truth.rotations.reshape(-1, 3, 3), np.tile(np.arange(3), 20))
    assert found is not None
    assert np.degrees(np.arccos(found[0][2])) < 0.7


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_images_that_are_stored_turned(tmp_path: Path, turns: int) -> None:
    """Held upright, as phones are: what is down in the world is right, up or left in the stored image."""
    truth = drive(pitch_deg=4.0)
    right, down = truth.rotations[:, :, 0].copy(), truth.rotations[:, :, 1].copy()
    stored = truth.rotations.copy()
    stored[:, :, 0], stored[:, :, 1] = {1: (down, -right), 2: (-right, -down), 3: (-down, right)}[turns]
    turned = replace(truth, rotations=stored)
    captured = inventory(turned)
    images = tuple(replace(image, quarter_turns=turns) for image in captured.images)
    found, model = run(tmp_path, turned, replace(captured, images=images))
    assert tilt_deg(turned, model) < 1.0
    assert found.gravity_source is GravitySource.CAMERAS_AND_GROUND


def test_the_ground_tells_the_pitch_of_a_single_camera(tmp_path: Path) -> None:
    truth = drive(40, corner=False, pitch_deg=10.0)
    write_model(truth, tmp_path / "sfm", random_similarity(3), cameras=(0,))
    found = georegister(tmp_path / "sfm", None, tmp_path / "out", options=GeoregisterOptions())
    assert found.gravity_source is GravitySource.CAMERAS_AND_GROUND
    assert tilt_deg(truth, pycolmap.Reconstruction(tmp_path / "out" / "model")) < 1.0


def test_gps_heights_tell_a_slope_from_a_tilt(tmp_path: Path) -> None:
    """Cameras and ground both lean with the road."""
    truth = on_a_slope(drive(), 6.0)
    found, model = run(tmp_path, truth, inventory(truth))
    assert tilt_deg(truth, model) == pytest.approx(6.0, abs=0.7)
    found, model = run(tmp_path, truth, inventory(truth, gps_m=noisy(truth, 0.05)))
    assert tilt_deg(truth, model) < 0.7
    assert found.gravity_source in (GravitySource.GPS, GravitySource.GPS_AND_CAMERAS)


def test_without_an_inventory(tmp_path: Path) -> None:
    truth = drive()
    _, model = run(tmp_path, truth, None)
    assert tilt_deg(truth, model) < 1.0


def test_camera_height_and_scale(tmp_path: Path) -> None:
    truth = drive()
    found, _ = run(tmp_path, truth, inventory(truth), camera_height_m=HEIGHT_M)
    assert found.is_metric and found.scale_source is ScaleSource.CAMERA_HEIGHT
    assert found.scale_candidates[0].metres_per_model_unit == pytest.approx(1.0 / 0.137, rel=0.03)
    found, _ = run(tmp_path, truth, inventory(truth), camera_height_m=HEIGHT_M, scale=3.0)
    assert found.scale_source is ScaleSource.OPTION
    assert found.scale_candidates[0].metres_per_model_unit == 3.0


def rig_file(folder: Path) -> Path:
    truth = drive(1, roll_deg=0.0)
    cameras: list[dict[str, object]] = [{"image_prefix": "cam0/", "ref_sensor": True}]
    for camera in (1, 2):
        rotation = truth.rotations[0, camera] @ truth.rotations[0, 0].T
        translation = truth.rotations[0, camera] @ (truth.centers_m[0, 0] - truth.centers_m[0, camera])
        x, y, z, w = pycolmap.Rotation3d(rotation).quat
        pose = {"cam_from_rig_rotation": [w, x, y, z], "cam_from_rig_translation": translation.tolist()}
        cameras.append({"image_prefix": f"cam{camera}/", **pose})
    path = folder / "rig_config.json"
    path.write_text(json.dumps([{"cameras": cameras}]))
    return path


def test_the_rigs_baseline_gives_the_scale(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    truth = drive()
    captured = replace(inventory(truth), rig_file=rig_file(tmp_path))
    found, _ = run(tmp_path, truth, captured)
    assert found.scale_source is ScaleSource.RIG
    assert found.scale_candidates[0].metres_per_model_unit == pytest.approx(1.0 / 0.137, rel=1e-3)
    # GPS of 4 m noise over 29 m knows the scale worse than the rig; of 0.02 m noise it knows it better.
    for sigma_m, source in ((4.0, ScaleSource.RIG), (0.02, ScaleSource.GPS)):
        noisy_frames = replace(inventory(truth, gps_m=noisy(truth, sigma_m)), rig_file=captured.rig_file)
        found, model = run(tmp_path, truth, noisy_frames)
        assert found.scale_source is source
        assert tilt_deg(truth, model) < 1.2
        assert errors_m(truth, model, found).max() < 1.5 * sigma_m
    assert "times the one from" not in caplog.text
    wrong = replace(inventory(truth, gps_m=2.0 * truth.centers_m[:, 0]), rig_file=captured.rig_file)
    run(tmp_path, truth, wrong)
    assert "the scale from rig is 0.500 times the one from gps" in caplog.text


def test_known_positions_give_the_scale_and_not_the_up_direction(tmp_path: Path) -> None:
    """KITTI's poses are in metres, in the frame of the first camera (y down)."""
    truth = drive()
    kitti = (truth.centers_m[:, 0] - truth.centers_m[0, 0]) @ truth.rotations[0, 0].T
    found, model = run(tmp_path, truth, inventory(truth, positions_m=kitti))
    assert found.scale_source is ScaleSource.POSES and found.is_metric
    assert found.scale_candidates[0].metres_per_model_unit == pytest.approx(1.0 / 0.137, rel=1e-3)
    assert tilt_deg(truth, model) < 1.0


def test_a_level_model_stays_as_it_is(tmp_path: Path) -> None:
    truth = drive()
    similarity = pycolmap.Sim3d(1.0, pycolmap.Rotation3d(np.eye(3)), np.array([100.0, 200.0, 5.0]))
    found, model = run(tmp_path, truth, None, similarity=similarity, z_is_up=True, scale=1.0)
    assert found.world_from_model == (1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0)
    assert found.gravity_source is GravitySource.MODEL and found.is_metric
    center = model.find_image_with_name("cam0/000000.jpg").projection_center()
    assert np.allclose(center, truth.centers_m[0, 0] + (100.0, 200.0, 5.0))


def test_cameras_lying_on_their_side_are_overruled_by_gps(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    truth = drive(40)
    quarter = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    lying = replace(truth, rotations=quarter @ truth.rotations)
    found, model = run(tmp_path, lying, inventory(truth, gps_m=noisy(truth, 0.1)))
    assert found.gravity_source is GravitySource.GPS
    assert tilt_deg(lying, model) < 1.5
    assert "degrees off the one that GPS gives" in caplog.text


def test_the_same_bytes_twice(tmp_path: Path) -> None:
    truth = drive()
    for name in "ab":
        run(tmp_path / name, truth, inventory(truth, gps_m=noisy(truth, 0.5)))
    files = sorted(path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*") if path.is_file())
    assert len(files) >= 8
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes(), file


def test_the_old_model_may_lie_in_the_way(tmp_path: Path) -> None:
    truth = drive()
    for _ in range(2):
        found, _ = run(tmp_path, truth, inventory(truth))
    assert {path.name for path in (tmp_path / "georegister").iterdir()} == {"model", "georeference.json"}


def test_models_that_cannot_be_used(tmp_path: Path) -> None:
    truth = drive(4)
    options = GeoregisterOptions()
    with pytest.raises(InputError):
        georegister(tmp_path / "absent", None, tmp_path / "out", options=options)
    write_model(truth, tmp_path / "sfm")
    others = inventory(truth)
    renamed = [replace(f, images={c: f"x/{i}" for c, i in f.images.items()}) for f in others.frames]
    with pytest.raises(InputError, match="not among the captured ones"):
        georegister(tmp_path / "sfm", replace(others, frames=tuple(renamed)), tmp_path / "out", options=options)
    model = pycolmap.Reconstruction(tmp_path / "sfm")
    model.frame(1).rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(np.eye(3)), np.array([np.nan, 0.0, 0.0]))
    model.write_binary(tmp_path / "sfm")
    with pytest.raises(InputError, match="not finite"):
        georegister(tmp_path / "sfm", None, tmp_path / "out", options=options)


def test_too_little_gps_is_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    truth = drive()
    few = inventory(truth, gps_m=truth.centers_m[:, 0])
    few = replace(few, frames=tuple(replace(f, gps=f.gps if i < 2 else None) for i, f in enumerate(few.frames)))
    with caplog.at_level(logging.WARNING):
        found, _ = run(tmp_path, truth, few)
    assert found.crs == "local" and "only 2 registered frames have GPS" in caplog.text
    one_place = inventory(truth, gps_m=np.zeros((20, 3)))
    found, model = run(tmp_path, truth, one_place)
    assert not found.is_metric
    assert tilt_deg(truth, model) < 1.0


@pytest.mark.parametrize("values", [{"scale": 0.0}, {"camera_height_m": float("inf")}, {"seed": -1}])
def test_options_are_checked(values: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(values))):
        GeoregisterOptions(**values)  # type: ignore[arg-type]
