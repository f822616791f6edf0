"""Structure-from-Motion on a few frames of the sample street, against its exact ground truth."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray

from app.capture.inventory import CameraEntry, FrameEntry, ImageEntry, Inventory
from app.errors import DiskFullError, InputError
from app.sfm import stage
from app.sfm.database import copy_for_mapping
from app.sfm.mapping import incremental_options, map_incrementally, mend
from app.sfm.options import SfmOptions, Strategy
from app.sfm.report import SfmReport
from app.sfm.rigs import write_rigs
from app.sfm.stage import run_sfm
from app.sfm.steadiness import num_steady_images

STREET = Path(__file__).resolve().parents[2] / "sample_data" / "street"
OPTIONS = SfmOptions(num_threads=2, max_num_features=1500)
NUM_FRAMES = 5


def make_inventory(root: Path, names: list[str], *, rig: Path | None = None) -> Inventory:
    frames: dict[str, dict[str, str]] = {}
    for name in sorted(names):
        frames.setdefault(Path(name).stem, {})[str(Path(name).parent)] = name
    cameras = sorted({camera for images in frames.values() for camera in images})
    return Inventory(
        image_root=root,
        cameras=tuple(CameraEntry(name=camera, width=640, height=400, num_images=len(frames)) for camera in cameras),
        frames=tuple(FrameEntry(name=stem, images=images) for stem, images in sorted(frames.items())),
        images=tuple(ImageEntry(name=name, size_bytes=1, digest="") for name in sorted(names)),
        is_rig=len(cameras) > 1,
        rig_file=rig,
    )


@pytest.fixture(scope="module")
def street() -> Inventory:
    names = [f"cam{camera}/{frame:06d}.jpg" for camera in range(3) for frame in range(NUM_FRAMES)]
    return make_inventory(STREET / "images", names, rig=STREET / "rig.json")


@pytest.fixture(scope="module")
def finished(street: Inventory, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, SfmReport]:
    output = tmp_path_factory.mktemp("sfm") / "out"
    return output, run_sfm(street, output, options=OPTIONS)


def true_centers() -> dict[str, NDArray[np.float64]]:
    entries = json.loads((STREET / "poses_gt.json").read_text(encoding="utf-8"))
    return {entry["image"]: np.array(entry["C"]) for entry in entries}


def errors_and_scale(model: pycolmap.Reconstruction) -> tuple[NDArray[np.float64], float]:
    """Distances to the true projection centres in metres after the best similarity, and its scale."""
    truth = true_centers()
    images = [model.image(image_id) for image_id in model.reg_image_ids()]
    source = np.array([image.projection_center() for image in images])
    target = np.array([truth[image.name] for image in images])
    found = pycolmap.estimate_sim3d(source, target)
    assert found is not None
    aligned = np.array([found * center for center in source])
    return np.linalg.norm(aligned - target, axis=1), float(found.scale)


def model_bytes(output: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted((output / "model").iterdir())}


def test_all_images_register_accurately_and_to_scale(finished: tuple[Path, SfmReport]) -> None:
    output, report = finished
    assert report.registered == report.images == 3 * NUM_FRAMES
    assert report.attempts[0].with_rig
    assert report.mean_reprojection_error_px < 0.5
    model = pycolmap.Reconstruction(output / "model")
    errors_m, scale = errors_and_scale(model)
    assert np.median(errors_m) < 0.02
    assert scale == pytest.approx(1.0, abs=0.02)
    assert model.num_rigs() == 1
    assert model.num_frames() == NUM_FRAMES
    assert any(point.color.any() for point in model.points3D.values())
    assert SfmReport.read(output / "report.json") == report
    assert "15 of 15 images registered" in report.describe()


def test_the_same_bytes_again_and_after_a_kill(
    street: Inventory, finished: tuple[Path, SfmReport], tmp_path: Path
) -> None:
    """What a kill leaves: features, half of the matches, a few of them unverified, no model."""
    output, _ = finished
    again = tmp_path / "again"
    again.mkdir()
    shutil.copy(output / "database.db", again)
    with pycolmap.Database.open(again / "database.db") as database:
        pairs = database.read_two_view_geometry_num_inliers()[0]
        for index, pair_id in enumerate(pairs[::2]):
            first, second = pycolmap.pair_id_to_image_pair(pair_id)
            database.delete_two_view_geometry(first, second)
            if index > 2:
                database.delete_matches(first, second)
        images = database.read_all_images()
    steps: list[int] = []
    run_sfm(street, again, options=OPTIONS, progress=lambda done, total: steps.append(done))
    assert len(images) == 15
    assert model_bytes(again) == model_bytes(output)
    assert steps == sorted(steps)
    assert steps[-1] == 1000


def test_an_unknown_rig_is_derived(street: Inventory, finished: tuple[Path, SfmReport], tmp_path: Path) -> None:
    output, _ = finished
    again = tmp_path / "again"
    again.mkdir()
    shutil.copy(output / "database.db", again)
    report = run_sfm(replace(street, rig_file=None), again, options=OPTIONS)
    assert report.registered == 15
    assert report.attempts[0].with_rig
    assert np.median(errors_and_scale(pycolmap.Reconstruction(again / "model"))[0]) < 0.02


def test_known_poses(street: Inventory, finished: tuple[Path, SfmReport], tmp_path: Path) -> None:
    output, _ = finished
    again = tmp_path / "again"
    again.mkdir()
    shutil.copy(output / "database.db", again)
    report = run_sfm(street, again, options=OPTIONS, pose_file=STREET / "poses_gt.txt")
    assert report.used == "known-poses"
    assert report.registered == 15
    assert report.mean_reprojection_error_px < 0.6
    model = pycolmap.Reconstruction(again / "model")
    truth = true_centers()
    for image_id in model.reg_image_ids():
        image = model.image(image_id)
        np.testing.assert_allclose(image.projection_center(), truth[image.name], atol=0.01)


def test_one_strategy_after_the_other_until_one_works(
    street: Inventory, finished: tuple[Path, SfmReport], tmp_path: Path
) -> None:
    """Without matches between the cameras no model holds more than a third of the images."""
    output, _ = finished
    again = tmp_path / "again"
    again.mkdir()
    shutil.copy(output / "database.db", again)
    with pycolmap.Database.open(again / "database.db") as database:
        camera = {image.image_id: image.camera_id for image in database.read_all_images()}
        for pair_id in database.read_two_view_geometry_num_inliers()[0]:
            first, second = pycolmap.pair_id_to_image_pair(pair_id)
            if camera[first] != camera[second]:
                geometry = pycolmap.TwoViewGeometry()
                database.update_two_view_geometry(first, second, geometry)
    single = replace(street, is_rig=False, rig_file=None)
    options = replace(OPTIONS, strategies=(Strategy.INCREMENTAL, Strategy.GLOBAL_RIG, Strategy.GLOBAL))
    report = run_sfm(single, again, options=options)
    assert [attempt.strategy for attempt in report.attempts] == ["incremental", "global"]
    assert report.registered == 5
    assert report.components == (5, 5, 5)
    assert sorted(path.name for path in (again / "components").iterdir()) == ["0", "1", "2"]
    assert set(report.unregistered.values()) == {"in another component"}


def test_a_torn_model_is_mended(street: Inventory, finished: tuple[Path, SfmReport], tmp_path: Path) -> None:
    """The images of one camera at a fifth of the scale, as moving cars can make them, are registered anew."""
    output, _ = finished
    copy_for_mapping(output / "database.db", tmp_path / "mapping.db")
    with pycolmap.Database.open(tmp_path / "mapping.db") as database:
        write_rigs(database, (), street)
    (right,) = map_incrementally(
        tmp_path / "mapping.db", street, tmp_path, incremental_options(OPTIONS, set()), lambda done, total: None
    )
    torn = pycolmap.Reconstruction(right)
    for image_id in torn.reg_image_ids():
        image = torn.image(image_id)
        if image.name.startswith("cam2/"):
            pose = image.cam_from_world()
            pose.translation = 0.2 * pose.translation
            torn.frame(image.frame_id).set_cam_from_world(image.camera_id, pose)
    assert num_steady_images(torn, street) == 2 * NUM_FRAMES
    mended = mend(torn, tmp_path / "mapping.db", street, tmp_path, incremental_options(OPTIONS, set()))
    assert num_steady_images(mended, street) == 3 * NUM_FRAMES
    errors, _ = errors_and_scale(mended)
    assert errors.max() < 0.05


def test_names_with_spaces_and_a_corrupted_database(tmp_path: Path) -> None:
    root = tmp_path / "my images"
    names = []
    for frame in range(4):
        name = f"front Ö/frame {frame}.jpg"
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(STREET / "images" / "cam1" / f"{frame:06d}.jpg", root / name)
        names.append(name)
    output = tmp_path / "out"
    output.mkdir()
    (output / "database.db").write_bytes(b"SQLite format 3\0" + bytes(5000))
    report = run_sfm(make_inventory(root, names), output, options=replace(OPTIONS, camera_model="SIMPLE_PINHOLE"))
    assert report.registered == 4
    model = pycolmap.Reconstruction(output / "model")
    assert sorted(image.name for image in model.images.values()) == names


def test_a_strategy_that_met_a_full_disk_is_tried_again(
    street: Inventory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*arguments: object, **options: object) -> None:
        raise DiskFullError(tmp_path)

    monkeypatch.setattr(stage, "run_isolated", fail)
    with pytest.raises(DiskFullError):
        stage._map(Strategy.INCREMENTAL, street, tmp_path / "d.db", None, tmp_path, OPTIONS, tmp_path / "log", None)
    assert not list(tmp_path.glob("*.done"))


def test_images_that_share_nothing(tmp_path: Path) -> None:
    generator = np.random.default_rng(1)
    names = ["a.png", "b.png", "blank.png"]
    for name in names[:2]:
        cv2.imwrite(str(tmp_path / name), generator.integers(0, 255, (400, 640), dtype=np.uint8))
    cv2.imwrite(str(tmp_path / names[2]), np.full((400, 640), 90, np.uint8))
    frames = tuple(FrameEntry(name=name, images={"": name}) for name in names)
    inventory = replace(
        make_inventory(tmp_path, names),
        cameras=(CameraEntry(name="", width=640, height=400, num_images=3),),
        frames=frames,
    )
    with pytest.raises(InputError, match="no two images in .* show the same thing"):
        run_sfm(inventory, tmp_path / "out", options=OPTIONS)
    with pytest.raises(InputError, match="at least two are needed"):
        run_sfm(replace(inventory, images=inventory.images[:1]), tmp_path / "out", options=OPTIONS)
