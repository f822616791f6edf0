"""Rigs: cameras that keep their relative poses, known from a file or derived from a model without rigs."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap

from app.capture.inventory import Inventory
from app.capture.rig import read_rig_file

logger = logging.getLogger(__name__)

_MIN_BASELINE_M = 0.02
"""Shorter baselines say nothing about scale."""


@dataclass(frozen=True, kw_only=True)
class RigSpec:
    """One rig of cameras, named as in the inventory, the reference camera first."""

    cam_from_rig: dict[str, pycolmap.Rigid3d | None]
    """Per camera; None where unknown, the identity for the reference camera. In metres if `is_metric`."""
    is_metric: bool
    """The poses come from a rig file, not from a model."""

    @property
    def is_calibrated(self) -> bool:
        """All poses are known."""
        return all(pose is not None for pose in self.cam_from_rig.values())

    @property
    def reference(self) -> str:
        """The reference camera."""
        return next(iter(self.cam_from_rig))


def rig_specs(inventory: Inventory) -> tuple[RigSpec, ...]:
    """The rigs of a set of images: those of its rig file, else one of all cameras with unknown poses, else none."""
    names = {camera.name for camera in inventory.cameras}
    if not inventory.is_rig or len(names) < 2:
        return ()
    if inventory.rig_file is None:
        ordered = sorted(names)
        poses: dict[str, pycolmap.Rigid3d | None] = {ordered[0]: pycolmap.Rigid3d()}
        return (RigSpec(cam_from_rig=poses | {name: None for name in ordered[1:]}, is_metric=False),)
    specs = []
    for rig in read_rig_file(inventory.rig_file):
        cameras = sorted(rig.cameras, key=lambda camera: not camera.ref_sensor)
        poses = {
            camera.image_prefix.rstrip("/"): pycolmap.Rigid3d() if camera.ref_sensor else camera.cam_from_rig
            for camera in cameras
        }
        if len(poses) > 1 and names.issuperset(poses):
            specs.append(RigSpec(cam_from_rig=poses, is_metric=all(pose is not None for pose in poses.values())))
    return tuple(specs)


def rigs_and_frames(
    specs: Sequence[RigSpec], inventory: Inventory, camera_ids: dict[str, int], image_ids: dict[str, int]
) -> tuple[list[pycolmap.Rig], list[pycolmap.Frame]]:
    """COLMAP's rigs and frames, without poses of the frames. Cameras in no rig get one of their own.

    Args:
        specs: the rigs.
        inventory: which images belong to a frame.
        camera_ids: COLMAP's ID by camera name.
        image_ids: COLMAP's ID by image name.
    """
    in_rigs = {name for spec in specs for name in spec.cam_from_rig}
    alone = [
        RigSpec(cam_from_rig={name: pycolmap.Rigid3d()}, is_metric=False) for name in camera_ids if name not in in_rigs
    ]
    rigs: list[pycolmap.Rig] = []
    frames: list[pycolmap.Frame] = []
    for rig_id, spec in enumerate((*specs, *alone), start=1):
        rig = pycolmap.Rig(rig_id=rig_id)
        for name, pose in spec.cam_from_rig.items():
            if name == spec.reference:
                rig.add_ref_sensor(_sensor(camera_ids[name]))
            else:
                rig.add_sensor(_sensor(camera_ids[name]), pose)
        rigs.append(rig)
        for entry in inventory.frames:
            images = [(name, image) for name, image in entry.images.items() if name in spec.cam_from_rig]
            groups = [images] if len(spec.cam_from_rig) > 1 and images else [[image] for image in images]
            for group in groups:
                frame = pycolmap.Frame(frame_id=len(frames) + 1, rig_id=rig_id)
                for name, image in group:
                    frame.add_data_id(pycolmap.data_t(_sensor(camera_ids[name]), image_ids[image]))
                frames.append(frame)
    return rigs, frames


def write_rigs(database: pycolmap.Database, specs: Sequence[RigSpec], inventory: Inventory) -> None:
    """Replace a database's rigs and frames."""
    camera_ids, image_ids = database_ids(database, inventory)
    rigs, frames = rigs_and_frames(specs, inventory, camera_ids, image_ids)
    with pycolmap.DatabaseTransaction(database):
        database.clear_frames()
        database.clear_rigs()
        for rig in rigs:
            database.write_rig(rig, use_rig_id=True)
        for frame in frames:
            database.write_frame(frame, use_frame_id=True)


def database_ids(database: pycolmap.Database, inventory: Inventory) -> tuple[dict[str, int], dict[str, int]]:
    """COLMAP's camera ID by camera name and image ID by image name."""
    images = {image.name: image for image in database.read_all_images()}
    cameras = {
        camera: images[image].camera_id for frame in inventory.frames for camera, image in sorted(frame.images.items())
    }
    return dict(sorted(cameras.items())), {name: image.image_id for name, image in images.items()}


def derive_rig(spec: RigSpec, model: pycolmap.Reconstruction, inventory: Inventory) -> RigSpec | None:
    """Fill in unknown poses of a rig from a model of single images: per camera the middle one over all frames.

    The middle one is the observed pose with the least sum of distances to the others, so that single wrong frames
    don't matter, unlike with a mean.

    Returns:
        The rig in the model's scale, or None where a camera is never registered together with the reference camera.
    """
    poses = image_poses(model)
    derived: dict[str, pycolmap.Rigid3d | None] = {spec.reference: pycolmap.Rigid3d()}
    for camera in list(spec.cam_from_rig)[1:]:
        observed = [
            poses[frame.images[camera]] * poses[frame.images[spec.reference]].inverse()
            for frame in inventory.frames
            if frame.images.get(camera) in poses and frame.images.get(spec.reference) in poses
        ]
        if not observed:
            return None
        derived[camera] = middle_pose(observed)
    return RigSpec(cam_from_rig=derived, is_metric=False)


def middle_pose(poses: Sequence[pycolmap.Rigid3d]) -> pycolmap.Rigid3d:
    """The pose with the least sum of distances to the others, angles and relative lengths weighted alike."""
    rotations = np.array([pose.rotation.matrix() for pose in poses])
    translations = np.array([pose.translation for pose in poses])
    length = max(float(np.median(np.linalg.norm(translations - np.median(translations, axis=0), axis=1))), 1e-12)
    sample = np.linspace(0, len(poses) - 1, min(len(poses), 200)).astype(int)
    cosines = np.clip((np.einsum("aij,bij->ab", rotations, rotations[sample]) - 1) / 2, -1, 1)
    angles = np.arccos(cosines)
    spread = max(float(np.median(angles)), 1e-12)
    distances = np.linalg.norm(translations[:, None] - translations[None, sample], axis=2)
    # A bounded cost, so that far outliers count no more than near ones.
    cost = np.minimum(angles / spread, 5).sum(axis=1) + np.minimum(distances / length, 5).sum(axis=1)
    return poses[int(np.argmin(cost))]


def scale_to_rigs(specs: Sequence[RigSpec], model: pycolmap.Reconstruction, inventory: Inventory) -> float | None:
    """Metres per unit of the model: known baselines over the model's; None where no baseline is known or seen."""
    centers = {name: pose.inverse().translation for name, pose in image_poses(model).items()}
    known_m, measured = 0.0, 0.0
    for spec in specs:
        in_rig = {name: pose.inverse().translation for name, pose in spec.cam_from_rig.items() if pose is not None}
        names = list(in_rig)
        for row, first in enumerate(names):
            for second in names[row + 1 :]:
                baseline_m = float(np.linalg.norm(in_rig[first] - in_rig[second]))
                lengths = [
                    np.linalg.norm(centers[frame.images[first]] - centers[frame.images[second]])
                    for frame in inventory.frames
                    if frame.images.get(first) in centers and frame.images.get(second) in centers
                ]
                if spec.is_metric and baseline_m >= _MIN_BASELINE_M and lengths:
                    known_m += baseline_m
                    measured += float(np.median(lengths))
    return known_m / measured if measured > 0 else None


def pose_frames(model: pycolmap.Reconstruction, poses: Mapping[str, pycolmap.Rigid3d]) -> None:
    """Register the frames of a model whose rigs are calibrated: each gets the middle one of the poses its images say.

    Images that have no pose of their own are registered with the others of their frame.

    Args:
        model: frames without poses.
        poses: cam_from_world by image name.
    """
    names = {image.image_id: image.name for image in model.images.values()}
    for frame_id, frame in model.frames.items():
        rig = model.rig(frame.rig_id)
        said = []
        for data in sorted(frame.data_ids, key=lambda data: int(data.id)):
            if names[data.id] in poses:
                from_rig = None if rig.is_ref_sensor(data.sensor_id) else rig.sensor_from_rig(data.sensor_id)
                pose = poses[names[data.id]]
                said.append(pose if from_rig is None else from_rig.inverse() * pose)
        if said:
            frame.rig_from_world = middle_pose(said)
            model.register_frame(frame_id)


def image_poses(model: pycolmap.Reconstruction) -> dict[str, pycolmap.Rigid3d]:
    """cam_from_world of each registered image by name."""
    return {model.image(image_id).name: model.image(image_id).cam_from_world() for image_id in model.reg_image_ids()}


def _sensor(camera_id: int) -> pycolmap.sensor_t:
    return pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id)
