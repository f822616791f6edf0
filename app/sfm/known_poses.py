"""Sparse points from images whose poses are known."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pycolmap

from app.capture.inventory import Inventory
from app.capture.poses import PoseFormat, match_poses, read_pose_file
from app.errors import InputError
from app.sfm.database import copy_for_mapping, remove_database
from app.sfm.mapping import adjust, fixed_cameras, load_unposed, triangulate
from app.sfm.options import SfmOptions
from app.sfm.rigs import rig_specs, write_rigs

logger = logging.getLogger(__name__)

Progress = Callable[[int, int], None]
Poses = dict[str, pycolmap.Rigid3d]
"""cam_from_world by image name."""
_ROUNDS = 3


def read_known_poses(path: Path, inventory: Inventory) -> Poses:
    """Poses of images from a file, or from a COLMAP model's folder.

    A file in TUM's or KITTI's format holds the poses of the rig's reference camera; those of the other cameras follow
    from the rig file.

    Raises:
        InputError: unreadable, or no pose belongs to an image.
    """
    if path.is_dir():
        path = path / "images.txt"
        if not path.exists():
            raise InputError(f"{path} is missing; give images.txt, or a whole model with `sfm --import`")
    pose_file = read_pose_file(path)
    specs = rig_specs(inventory)
    reference = specs[0].reference if specs else None
    found = match_poses(pose_file, inventory.frames, reference_camera=reference)
    poses = {name: pycolmap.Rigid3d(np.linalg.inv(pose)[:3]) for name, pose in found.items()}
    if pose_file.format is not PoseFormat.COLMAP and specs:
        for frame in inventory.frames:
            world = poses.get(frame.images.get(specs[0].reference, ""))
            for camera, cam_from_rig in specs[0].cam_from_rig.items():
                if world is not None and cam_from_rig is not None and camera in frame.images:
                    poses[frame.images[camera]] = cam_from_rig * world
    without = len(inventory.images) - len(poses)
    if without:
        logger.warning("%s gives no pose for %d of %d images; they are left out", path, without, len(inventory.images))
    return dict(sorted(poses.items()))


def map_with_poses(
    inventory: Inventory,
    database_path: Path,
    poses: Mapping[str, pycolmap.Rigid3d],
    output: Path,
    options: SfmOptions,
    progress: Progress,
) -> None:
    """Triangulate with fixed poses; unknown intrinsics are refined. Leaves a model in `output`.

    Raises:
        InputError: the poses contradict the images.
    """
    output.mkdir(parents=True, exist_ok=True)
    database = output / "mapping.db"
    copy_for_mapping(database_path, database)
    with pycolmap.Database.open(database) as handle:
        write_rigs(handle, (), inventory)
        fixed = fixed_cameras(handle, inventory, options)
    model = load_unposed(database, {})
    for image in model.images.values():
        if image.name in poses:
            frame = model.frame(image.frame_id)
            frame.rig_from_world = poses[image.name]
            model.register_frame(image.frame_id)
    refine = not fixed.issuperset(model.cameras)
    rounds = _ROUNDS if refine else 1
    for done in range(rounds):
        model = triangulate(model, database, inventory, output, options)
        if not model.num_points3D():
            raise InputError(
                "the known poses contradict the images: no point can be triangulated; check their convention"
            )
        adjust(model, fixed, [], options, robust=done == 0, fix_poses=True)
        progress(done + 1, rounds)
    remove_database(database)
    model.write_binary(output)
