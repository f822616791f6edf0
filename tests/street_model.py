"""A drive through a street as a COLMAP model with exact poses, for tests.

            facade  y = +8
    ------------------------------
      o--->---o--->---o--->  path along x, then (with a corner) along y
    ------------------------------
            facade  y = -8

World: z up, ground at z = 0, metres, first frame at (0, 0). Three cameras per frame at a height of 1.8 m: `cam0`
ahead, `cam1` to the left, `cam2` to the right, each `pitch_deg` down.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from app.capture.inventory import CameraEntry, FrameEntry, ImageEntry, Inventory

HEIGHT_M = 1.8
ORIGIN = (44.8, 10.3, 60.0)
"""Latitude, longitude and height of the world's origin; x is east."""
OFFSETS_M = ((0.0, 0.0), (-0.4, 0.6), (-0.4, -0.6))
"""Ahead and left of cam0."""


@dataclass(frozen=True)
class Drive:
    """The true poses. F frames, 3 cameras."""

    rotations: NDArray[np.float64]
    """(F, 3, 3, 3) cam_from_world."""
    centers_m: NDArray[np.float64]
    """(F, 3, 3)"""
    points_m: NDArray[np.float64]
    """(P, 3)"""


def drive(
    num_frames: int = 20, *, corner: bool = True, pitch_deg: float = 3.0, roll_deg: float = 0.5, seed: int = 0
) -> Drive:
    """A drive with 1.5 m per frame; each frame rolls and pitches a little by itself."""
    rng = np.random.default_rng(seed)
    turn = num_frames // 2 if corner else num_frames
    heading = np.where(np.arange(num_frames) < turn, 0.0, np.pi / 2)
    steps = 1.5 * np.column_stack((np.cos(heading), np.sin(heading), np.zeros(num_frames)))
    places = np.vstack((np.zeros(3), np.cumsum(steps[1:], axis=0)))
    rotations = np.empty((num_frames, 3, 3, 3))
    centers = np.empty((num_frames, 3, 3))
    for frame in range(num_frames):
        roll, pitch = np.radians(rng.normal(0.0, roll_deg, 2))
        for camera, yaw in enumerate((0.0, np.pi / 3, -np.pi / 3)):
            world_from_vehicle = _about_z(heading[frame])
            camera_down = _about_y(np.radians(pitch_deg) + pitch) @ _about_x(roll)
            axes = world_from_vehicle @ _about_z(yaw) @ camera_down
            # Columns ahead, left, up to rows right, down, ahead.
            rotations[frame, camera] = np.stack((-axes[:, 1], -axes[:, 2], axes[:, 0]))
            offset = np.array([*OFFSETS_M[camera], HEIGHT_M])
            centers[frame, camera] = places[frame] + world_from_vehicle @ offset
    low, high = places.min(axis=0)[:2] - 20.0, places.max(axis=0)[:2] + 20.0
    ground = np.column_stack((rng.uniform(low, high, (600, 2)), rng.normal(0.0, 0.02, 600)))
    along = rng.uniform(low[0], high[0], 500)
    walls = np.column_stack((along, rng.choice((-8.0, 8.0), 500), rng.uniform(0.0, 9.0, 500)))
    return Drive(rotations=rotations, centers_m=centers, points_m=np.vstack((ground, walls)))


def on_a_slope(truth: Drive, slope_deg: float) -> Drive:
    """The same drive up a road that climbs along x; its first point stays."""
    climb = _about_y(-np.radians(slope_deg))
    return Drive(
        rotations=truth.rotations @ climb.T, centers_m=truth.centers_m @ climb.T, points_m=truth.points_m @ climb.T
    )


def write_model(
    truth: Drive, folder: Path, model_from_world: pycolmap.Sim3d | None = None, cameras: tuple[int, ...] = (0, 1, 2)
) -> None:
    """Write the drive as a COLMAP model, moved, turned and scaled by a similarity."""
    model = pycolmap.Reconstruction()
    for camera in range(3):
        intrinsics = pycolmap.Camera.create_from_model_name(camera + 1, "PINHOLE", 400.0, 640, 480)
        model.add_camera_with_trivial_rig(intrinsics)
    tracks: list[list[tuple[int, int]]] = [[] for _ in truth.points_m]
    image_id = 0
    for frame in range(len(truth.centers_m)):
        for camera in cameras:
            image_id += 1
            rotation, center = truth.rotations[frame, camera], truth.centers_m[frame, camera]
            seen = (truth.points_m - center) @ rotation.T
            with np.errstate(divide="ignore", invalid="ignore"):
                pixels = 400.0 * seen[:, :2] / seen[:, 2:] + (320.0, 240.0)
            visible = (
                (seen[:, 2] > 1.0) & (seen[:, 2] < 30.0) & (pixels > 0).all(axis=1) & (pixels < (640, 480)).all(axis=1)
            )
            rows = np.flatnonzero(visible)
            for index, row in enumerate(rows):
                tracks[row].append((image_id, index))
            image = pycolmap.Image(f"cam{camera}/{frame:06d}.jpg", pixels[rows], camera + 1, image_id)
            pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ center)
            model.add_image_with_trivial_frame(image, pose)
    for point, elements in zip(truth.points_m, tracks, strict=True):
        if len(elements) > 1:
            track = pycolmap.Track()
            for element_image, index in elements:
                track.add_element(element_image, index)
            model.add_point3D(point, track, np.array([128, 128, 128], dtype=np.uint8))
    if model_from_world is not None:
        model.transform(model_from_world)
    folder.mkdir(parents=True, exist_ok=True)
    model.write_binary(folder)


def inventory(
    truth: Drive, *, gps_m: NDArray[np.float64] | None = None, positions_m: NDArray[np.float64] | None = None
) -> Inventory:
    """The drive's inventory. ``gps_m`` (F, 3) are GPS positions in the world (east, north, up of ORIGIN)."""
    frames = []
    geodetic = None
    if gps_m is not None:
        geodetic = pycolmap.GPSTransform().enu_to_ellipsoid(gps_m, *ORIGIN)
    for frame in range(len(truth.centers_m)):
        frames.append(
            FrameEntry(
                name=f"{frame:06d}",
                images={f"cam{camera}": f"cam{camera}/{frame:06d}.jpg" for camera in range(3)},
                gps=None if geodetic is None else tuple(geodetic[frame].tolist()),
                position_m=None if positions_m is None else tuple(positions_m[frame].tolist()),
            )
        )
    names = sorted(image for entry in frames for image in entry.images.values())
    return Inventory(
        image_root=Path("/images"),
        cameras=tuple(CameraEntry(name=f"cam{i}", width=640, height=480, num_images=len(frames)) for i in range(3)),
        frames=tuple(frames),
        images=tuple(ImageEntry(name=name, size_bytes=1, digest="") for name in names),
        is_rig=True,
    )


def random_similarity(seed: int, scale: float = 0.137) -> pycolmap.Sim3d:
    """A similarity that turns a model upside down or anywhere else."""
    rng = np.random.default_rng(seed)
    quaternion = rng.normal(size=4)
    rotation = pycolmap.Rotation3d(quaternion / np.linalg.norm(quaternion))
    return pycolmap.Sim3d(scale, rotation, rng.uniform(-10.0, 10.0, 3))


def _about_x(angle: float) -> NDArray[np.float64]:
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, cos, -sin], [0.0, sin, cos]])


def _about_y(angle: float) -> NDArray[np.float64]:
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])


def _about_z(angle: float) -> NDArray[np.float64]:
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
