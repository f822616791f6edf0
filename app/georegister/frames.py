"""The model's frames as arrays: where each was, in order of capture, and which image of which camera belongs to it."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.capture.inventory import FrameEntry, Inventory
from app.capture.scan import camera_of, natural_key
from app.errors import InputError
from app.scene.posed_scene import PosedScene

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class ModelFrames:
    """Frames with a registered image, in order of capture. F frames, N images of the scene, C cameras."""

    frames: tuple[FrameEntry, ...]
    positions_in_model: NDArray[np.float64]
    """(F, 3) centre of the frame's reference camera."""
    right_in_model: NDArray[np.float64] | None
    """(F, 3) x axis of the frame's reference camera; None where frames come from several cameras that are no rig."""
    upright_from_world: NDArray[np.float64]
    """(N, 3, 3) rotations of the scene's images as they are looked at: turned as EXIF says, so that y points down."""
    image_frames: NDArray[np.int64]
    """(N,) frame of each of the scene's images; -1 for images that the inventory doesn't have."""
    image_cameras: NDArray[np.int64]
    """(N,) index into ``cameras``."""
    cameras: tuple[str, ...]
    """Camera names (folders)."""


def model_frames(scene: PosedScene, inventory: Inventory | None) -> ModelFrames:
    """Group a model's images into frames.

    A rig's position is that of its first camera, also where another camera alone is registered: the offset between
    them is known from the frames that have both. So a missing image doesn't move a frame.

    Args:
        scene: the model.
        inventory: the frames; without it each image is a frame of its own.

    Raises:
        InputError: the inventory has none of the model's images.
    """
    if inventory is None:
        entries: Sequence[FrameEntry] = [
            FrameEntry(name=name, images={camera_of(name): name}) for name in sorted(scene.image_names, key=natural_key)
        ]
        is_rig = False
    else:
        entries, is_rig = inventory.frames, inventory.is_rig
    row_of = {name: row for row, name in enumerate(scene.image_names)}
    kept = [entry for entry in entries if any(image in row_of for image in entry.images.values())]
    if not kept:
        raise InputError(
            f"the model's images (first {scene.image_names[0]!r}) are not among the captured ones; "
            "image names in the model must be relative to the image folder"
        )
    image_frames = np.full(len(scene.image_names), -1, dtype=np.int64)
    for index, entry in enumerate(kept):
        for image in entry.images.values():
            if image in row_of:
                image_frames[row_of[image]] = index
    unknown = int((image_frames < 0).sum())
    if unknown:
        logger.warning("%d of the model's %d images are not among the captured ones", unknown, len(image_frames))
    names = [camera_of(name) for name in scene.image_names]
    cameras = tuple(sorted(set(names), key=natural_key))
    index_of = {camera: index for index, camera in enumerate(cameras)}
    image_cameras = np.array([index_of[name] for name in names], dtype=np.int64)
    turns = {image.name: image.quarter_turns for image in inventory.images} if inventory is not None else {}
    upright = turned_upright(
        scene.cam_from_world[:, :, :3], np.array([turns.get(name, 0) for name in scene.image_names], dtype=np.int64)
    )
    positions, right = _reference_cameras(scene, upright, image_frames, image_cameras, len(kept), is_rig)
    return ModelFrames(
        frames=tuple(kept),
        positions_in_model=positions,
        right_in_model=right if is_rig or len(cameras) == 1 else None,
        upright_from_world=upright,
        image_frames=image_frames,
        image_cameras=image_cameras,
        cameras=cameras,
    )


def turned_upright(rotations: NDArray[np.float64], quarter_turns: NDArray[np.int64]) -> NDArray[np.float64]:
    """(N, 3, 3) rotations of cameras whose images are turned clockwise by (N,) quarter turns.

    What was right in the stored image is down after one turn, and what was up is right.
    """
    x, y = rotations[:, 0], rotations[:, 1]
    turned = rotations.copy()
    for turns, (right, down) in {1: (-y, x), 2: (-x, -y), 3: (y, -x)}.items():
        chosen = quarter_turns == turns
        turned[chosen, 0], turned[chosen, 1] = right[chosen], down[chosen]
    return turned


def _reference_cameras(
    scene: PosedScene,
    upright_from_world: NDArray[np.float64],
    image_frames: NDArray[np.int64],
    image_cameras: NDArray[np.int64],
    num_frames: int,
    is_rig: bool,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(F, 3) centre and (F, 3) x axis of each frame's reference camera.

    In a rig every camera says where the reference camera is; the centre is the median of that, so that one camera with
    a bad track doesn't bend the drive.
    """
    centers = scene.centers_in_world
    rotations = scene.cam_from_world[:, :, :3]
    num_cameras = int(image_cameras.max()) + 1
    row = np.full((num_cameras, num_frames), -1, dtype=np.int64)
    known = np.flatnonzero(image_frames >= 0)
    row[image_cameras[known], image_frames[known]] = known
    positions = np.full((num_frames, 3), np.nan)
    right = np.full((num_frames, 3), np.nan)
    said = np.full((num_cameras, num_frames, 3), np.nan)
    # The camera with the most images first, so that most offsets come from many frames.
    order = np.argsort(-(row >= 0).sum(axis=1), kind="stable")
    for camera in order:
        here = row[camera] >= 0
        rows = row[camera, here]
        estimate, axes = centers[rows], upright_from_world[rows, 0, :]
        both = here & np.isfinite(positions[:, 0])
        if is_rig and both.any():
            shared = row[camera, both]
            offset = np.median(_rotate(rotations[shared], positions[both] - centers[shared]), axis=0)
            axis = np.median(_rotate(rotations[shared], right[both]), axis=0)
            from_camera = rotations[rows].transpose(0, 2, 1)
            estimate = estimate + from_camera @ offset
            axes = from_camera @ (axis / np.linalg.norm(axis))
        said[camera, here] = estimate
        missing = ~np.isfinite(positions[here, 0])
        positions[np.flatnonzero(here)[missing]] = estimate[missing]
        right[np.flatnonzero(here)[missing]] = axes[missing]
    return np.nanmedian(said, axis=0) if is_rig else positions, right


def _rotate(rotations: NDArray[np.float64], vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 3) each vector by its (3, 3) rotation."""
    rotated: NDArray[np.float64] = np.einsum("nij,nj->ni", rotations, vectors)
    return rotated
