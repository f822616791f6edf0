"""Rigs: derived from a model whatever its outliers, and its scale found from known baselines."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray

from app.capture.inventory import CameraEntry, FrameEntry, ImageEntry, Inventory
from app.sfm.rigs import RigSpec, derive_rig, middle_pose, pose_frames, rigs_and_frames, scale_to_rigs
from app.sfm.steadiness import num_steady_images, steady_cameras

SIDE_FROM_FRONT = pycolmap.Rigid3d(
    pycolmap.Rotation3d(np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])), [0.2, 0.0, -0.5]
)


def inventory() -> Inventory:
    frames = tuple(
        FrameEntry(name=f"{number}", images={name: f"{name}/{number}.jpg" for name in ("front", "side")})
        for number in range(9)
    )
    names = sorted(name for frame in frames for name in frame.images.values())
    return Inventory(
        image_root=Path("images"),
        cameras=tuple(CameraEntry(name=name, width=100, height=80, num_images=9) for name in ("front", "side")),
        frames=frames,
        images=tuple(ImageEntry(name=name, size_bytes=1, digest="") for name in names),
        is_rig=True,
    )


def pose_of_frame(number: int) -> pycolmap.Rigid3d:
    angle = 0.1 * number
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    return pycolmap.Rigid3d(pycolmap.Rotation3d(turn), [0.1 * number, 0.0, -1.5 * number])


def single_images(poses: dict[str, NDArray[np.float64]]) -> pycolmap.Reconstruction:
    model = pycolmap.Reconstruction()
    for camera_id in (1, 2):
        camera = pycolmap.Camera.create_from_model_name(camera_id, "PINHOLE", 90.0, 100, 80)
        camera.camera_id = camera_id
        model.add_camera_with_trivial_rig(camera)
    for image_id, (name, pose) in enumerate(sorted(poses.items()), start=1):
        image = pycolmap.Image(name=name, camera_id=1 if name.startswith("front") else 2, image_id=image_id)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    return model


def true_poses() -> dict[str, NDArray[np.float64]]:
    poses = {}
    for number in range(9):
        poses[f"front/{number}.jpg"] = pose_of_frame(number).matrix()
        poses[f"side/{number}.jpg"] = (SIDE_FROM_FRONT * pose_of_frame(number)).matrix()
    return poses


def test_a_rig_is_derived_in_spite_of_wrong_frames() -> None:
    poses = true_poses()
    for number in (2, 5, 7):
        poses[f"side/{number}.jpg"] = poses[f"front/{number}.jpg"]
    unknown = RigSpec(cam_from_rig={"front": pycolmap.Rigid3d(), "side": None}, is_metric=False)
    derived = derive_rig(unknown, single_images(poses), inventory())
    assert derived is not None
    assert derived.is_calibrated
    side = derived.cam_from_rig["side"]
    assert side is not None
    np.testing.assert_allclose(side.matrix(), SIDE_FROM_FRONT.matrix(), atol=1e-9)


def test_a_rig_with_a_camera_never_seen_is_not_derived() -> None:
    poses = {name: pose for name, pose in true_poses().items() if name.startswith("front")}
    unknown = RigSpec(cam_from_rig={"front": pycolmap.Rigid3d(), "side": None}, is_metric=False)
    assert derive_rig(unknown, single_images(poses), inventory()) is None


def test_scale_from_baselines() -> None:
    model = single_images(true_poses())
    model.transform(pycolmap.Sim3d(0.25, pycolmap.Rotation3d(), [3.0, 4.0, 5.0]))
    known = RigSpec(cam_from_rig={"front": pycolmap.Rigid3d(), "side": SIDE_FROM_FRONT}, is_metric=True)
    assert scale_to_rigs([known], model, inventory()) == pytest.approx(4.0)
    no_length = RigSpec(cam_from_rig=known.cam_from_rig, is_metric=False)
    assert scale_to_rigs([no_length], model, inventory()) is None


def test_frames_pose_images_that_have_none() -> None:
    poses = true_poses()
    known = RigSpec(cam_from_rig={"front": pycolmap.Rigid3d(), "side": SIDE_FROM_FRONT}, is_metric=True)
    model = single_images(poses)
    image_ids = {image.name: image.image_id for image in model.images.values()}
    model.set_rigs_and_frames(*rigs_and_frames([known], inventory(), {"front": 1, "side": 2}, image_ids))
    given = {name: pycolmap.Rigid3d(pose) for name, pose in poses.items() if name not in {"side/0.jpg", "front/4.jpg"}}
    pose_frames(model, given)
    assert model.num_reg_images() == 18
    for name, pose in poses.items():
        found = model.find_image_with_name(name).cam_from_world().matrix()
        np.testing.assert_allclose(found, pose, atol=1e-9)


def test_the_middle_pose_is_one_of_the_majority() -> None:
    near = [pycolmap.Rigid3d(pycolmap.Rotation3d(), [0.01 * step, 0.0, 0.0]) for step in range(5)]
    far = [pycolmap.Rigid3d(pycolmap.Rotation3d(), [100.0, 0.0, 0.0])] * 2
    assert middle_pose([*far, *near]).translation[0] <= 0.04


def test_a_camera_torn_from_the_others_is_found() -> None:
    """The side camera's drive, right in itself, at another scale; a moment's delay is no tear."""
    assert steady_cameras(single_images(true_poses()), inventory()) == {"front", "side"}
    torn, late = true_poses(), true_poses()
    for number in range(9):
        name = f"side/{number}.jpg"
        torn[name][:, 3] *= 0.5
        late[name][:, 3] += late[name][:, :3] @ [0.0, 0.0, 0.4 * np.sin(number)]
    del torn["side/8.jpg"]
    assert steady_cameras(single_images(torn), inventory()) == {"front"}
    assert num_steady_images(single_images(torn), inventory()) == 9
    assert steady_cameras(single_images(late), inventory()) == {"front", "side"}
    assert steady_cameras(single_images(torn), replace(inventory(), is_rig=False)) == {"front", "side"}
