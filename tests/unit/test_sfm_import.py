"""Taking over an existing COLMAP model: what is accepted, what is refused, what is left out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from app.capture.inventory import CameraEntry, FrameEntry, ImageEntry, Inventory
from app.errors import InputError
from app.sfm.imports import import_model


@pytest.fixture
def model() -> pycolmap.Reconstruction:
    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions(num_rigs=2, num_cameras_per_rig=1, num_frames_per_rig=3, num_points3D=30)
    return pycolmap.synthesize_dataset(options)


def inventory_of(model: pycolmap.Reconstruction, names: list[str] | None = None) -> Inventory:
    images = {image.name: model.camera(image.camera_id) for image in model.images.values()}
    kept = sorted(images) if names is None else names
    camera = next(iter(images.values()))
    return Inventory(
        image_root=Path("photos"),
        cameras=(CameraEntry(name="", width=camera.width, height=camera.height, num_images=len(kept)),),
        frames=tuple(FrameEntry(name=name, images={"": name}) for name in kept),
        images=tuple(ImageEntry(name=name, size_bytes=1, digest="") for name in kept),
        is_rig=False,
    )


def save(model: pycolmap.Reconstruction, folder: Path) -> Path:
    folder.mkdir(parents=True)
    model.write_binary(folder)
    return folder


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("old", [False, True])
def test_text_and_binary_with_and_without_rigs(
    model: pycolmap.Reconstruction, tmp_path: Path, text: bool, old: bool
) -> None:
    folder = tmp_path / "a model" / "sparse" / "0"
    folder.mkdir(parents=True)
    model.write_text(folder) if text else model.write_binary(folder)
    if old:
        for stem in ("rigs", "frames"):
            (folder / f"{stem}.{'txt' if text else 'bin'}").unlink()
    report = import_model(tmp_path / "a model", tmp_path / "out", inventory=inventory_of(model))
    assert report is not None
    assert (report.used, report.registered, report.images, report.points) == ("imported", 6, 6, 30)
    imported = pycolmap.Reconstruction(tmp_path / "out" / "model")
    for image_id in model.reg_image_ids():
        expected = model.image(image_id).cam_from_world().matrix()
        found = imported.find_image_with_name(model.image(image_id).name)
        np.testing.assert_allclose(found.cam_from_world().matrix(), expected, atol=1e-9)


def test_images_that_are_not_there_are_left_out(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    names = sorted(image.name for image in model.images.values())
    report = import_model(
        save(model, tmp_path / "in"), tmp_path / "out", inventory=inventory_of(model, [*names[1:], "more.jpg"])
    )
    assert report is not None
    assert report.registered == 5
    assert report.unregistered == {"more.jpg": "no pose given"}
    imported = pycolmap.Reconstruction(tmp_path / "out" / "model")
    assert sorted(imported.image(image_id).name for image_id in imported.reg_image_ids()) == names[1:]
    observed = {element.image_id for point in imported.points3D.values() for element in point.track.elements}
    assert observed <= set(imported.reg_image_ids())


def test_another_set_of_images_is_refused(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="6 of its 6 images are not in photos"):
        import_model(save(model, tmp_path / "in"), tmp_path / "out", inventory=inventory_of(model, ["other.jpg"]))


def test_another_image_size_is_refused(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    inventory = inventory_of(model)
    for camera in model.cameras.values():
        camera.width *= 2
    with pytest.raises(InputError, match="in the model, but"):
        import_model(save(model, tmp_path / "in"), tmp_path / "out", inventory=inventory)


def spoil_pose(model: pycolmap.Reconstruction) -> None:
    frame = model.frame(min(model.reg_frame_ids()))
    frame.rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(), [np.nan, 0.0, 0.0])


def spoil_point(model: pycolmap.Reconstruction) -> None:
    model.point3D(min(model.point3D_ids())).xyz = [0.0, np.inf, 0.0]


def spoil_camera(model: pycolmap.Reconstruction) -> None:
    camera = model.camera(min(model.cameras))
    camera.params = [np.nan, *camera.params[1:]]


def escape(model: pycolmap.Reconstruction) -> None:
    model.image(min(model.images)).name = "../../etc/passwd"


def escape_absolutely(model: pycolmap.Reconstruction) -> None:
    model.image(min(model.images)).name = "/etc/passwd"


def empty(model: pycolmap.Reconstruction) -> None:
    model.delete_all_points2D_and_points3D()


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (spoil_pose, "pose of .* is not finite"),
        (spoil_point, "3D points are not finite"),
        (spoil_camera, "parameters of camera"),
        (escape, "leaves the image folder"),
        (escape_absolutely, "leaves the image folder"),
        (empty, "is empty"),
    ],
)
def test_bad_models_are_refused_in_one_line(
    model: pycolmap.Reconstruction,
    tmp_path: Path,
    spoil: Callable[[pycolmap.Reconstruction], None],
    message: str,
) -> None:
    spoil(model)
    with pytest.raises(InputError, match=message) as caught:
        import_model(save(model, tmp_path / "in"), tmp_path / "out")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out" / "model").exists()


def test_no_model_and_a_truncated_one(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no COLMAP model"):
        import_model(tmp_path, tmp_path / "out")
    folder = save(model, tmp_path / "in")
    content = (folder / "images.bin").read_bytes()
    (folder / "images.bin").write_bytes(content[: len(content) // 2])
    with pytest.raises((InputError, RuntimeError)) as caught:
        import_model(folder, tmp_path / "out")
    assert isinstance(caught.value, InputError)
