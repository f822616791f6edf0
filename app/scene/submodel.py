"""Part of a scene -> a small COLMAP model."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from app.scene.posed_scene import PosedScene


def write_submodel(
    scene: PosedScene, image_rows: NDArray[np.integer], point_rows: NDArray[np.integer], output_dir: Path
) -> None:
    """Write chosen images and points as a binary COLMAP model with undistorted (PINHOLE) cameras.

    Images, cameras and points keep their IDs; each camera is a rig of its own and each image a frame of its own. The
    2D points of an image are the projections of the points that its tracks say it sees; observations in other images
    or behind the camera are left out, and points without any observation too.

    Args:
        scene: What to take from.
        image_rows: Rows of the images to keep.
        point_rows: Rows of the points to keep.
        output_dir: Created if need be. The same arguments give the same bytes.
    """
    images, points = np.unique(image_rows), np.unique(point_rows)
    point_of_observation, image_of_observation, pixels = _observations(scene, images, points)
    model = pycolmap.Reconstruction()
    for row in np.unique(scene.camera_index[images]):
        width, height = (int(side) for side in scene.camera_sizes_px[row])
        params = [float(value) for value in scene.camera_params_px[row]]
        camera = pycolmap.Camera(
            camera_id=int(scene.camera_ids[row]), model="PINHOLE", width=width, height=height, params=params
        )
        model.add_camera_with_trivial_rig(camera)
    by_image = np.argsort(image_of_observation, kind="stable")
    starts = np.searchsorted(image_of_observation[by_image], np.append(images, images[-1:] + 1))
    slot_in_image = np.empty(len(pixels), dtype=np.int64)
    for row, start, end in zip(images, starts[:-1], starts[1:], strict=True):
        in_image = by_image[start:end]
        slot_in_image[in_image] = np.arange(len(in_image))
        image = pycolmap.Image(
            name=scene.image_names[row],
            keypoints=pixels[in_image],
            camera_id=int(scene.camera_ids[scene.camera_index[row]]),
            image_id=int(scene.image_ids[row]),
        )
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(scene.cam_from_world[row]))
    bounds = np.searchsorted(point_of_observation, np.append(points, points[-1:] + 1))
    for row, start, end in zip(points, bounds[:-1], bounds[1:], strict=True):
        if start == end:
            continue
        track = pycolmap.Track(
            [
                pycolmap.TrackElement(int(scene.image_ids[image]), int(slot))
                for image, slot in zip(image_of_observation[start:end], slot_in_image[start:end], strict=True)
            ]
        )
        point = pycolmap.Point3D(xyz=scene.points_in_world[row], color=scene.point_colors[row], track=track)
        model.add_point3D_with_id(int(scene.point_ids[row]), point)
    output_dir.mkdir(parents=True, exist_ok=True)
    model.write_binary(output_dir)


def _observations(
    scene: PosedScene, images: NDArray[np.integer], points: NDArray[np.integer]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Rows of points (ascending) and images, and pixels (n, 2), of what the images see of the points by track."""
    places, observing = scene.observations(points)
    point_rows, image_rows = points[places].astype(np.int64), observing.astype(np.int64)
    wanted = np.isin(image_rows, images)
    point_rows, image_rows = point_rows[wanted], image_rows[wanted]

    matrices, slot = scene.image_from_world[images], np.searchsorted(images, image_rows)
    in_world = scene.points_in_world[point_rows]
    projected = np.einsum("nij,nj->ni", matrices[slot][:, :, :3], in_world) + matrices[slot][:, :, 3]
    in_front = projected[:, 2] > 0
    pixels = projected[in_front, :2] / projected[in_front, 2:]
    return point_rows[in_front], image_rows[in_front], pixels
