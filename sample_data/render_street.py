"""Render a drive through a procedural town, with exact ground truth.

    python -m sample_data.render_street OUT --seed 7 --path corner --frames 20

writes, into the folder OUT:

    images/cam0/000000.jpg ...  one folder per camera; the same file name means the same instant
    rig.json                    calibration of the cameras, as `pycolmap.read_rig_config` reads it
    gps.csv                     frame,lat,lon,alt: position of cam0 with noise
    poses_gt.txt                TUM: frame, position and orientation (x y z, qx qy qz qw) of cam0 in the world
    poses_gt.json               per image: R and t with ``x_cam = R x_world + t``, and the centre C
    gt.ply                      samples with normals of all surfaces that some camera sees
    gt_mesh.ply                 the whole town
    truth.json                  the options, the camera, the origin, and the share of plain wall

World: x east, y north, z up, metres, relative to the origin in truth.json; the road is at z = 0.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import pycolmap
import typer
from numpy.typing import NDArray

from fusion.cloud import PointCloud, write_ply
from fusion.thinning import thin
from sample_data.street_camera import Camera, Pose, TownRenderer, rig_cameras, rig_poses
from sample_data.street_path import PathKind
from sample_data.street_scene import Town, build_town

ORIGIN_LAT_LON_ALT = (44.8014, 10.3273, 60.0)


@dataclass(frozen=True, kw_only=True)
class StreetOptions:
    """What to render."""

    seed: int = 7
    """Same seed, same town and same noise."""
    path: PathKind = PathKind.CORNER
    """Shape of the drive."""
    n_cameras: int = 3
    """On the vehicle: 1 forward, 2 as a stereo pair, 3 with the front sides, and so on around."""
    n_frames: int = 20
    frame_spacing_m: float = 1.5
    richness: float = 1.0
    """Texture, 0 (mostly plain walls, plain road) to 1 (about 18 % plain wall)."""
    gps_noise_m: float = 0.3
    """Standard deviation of each horizontal coordinate; the height has one and a half times as much."""
    width: int = 640
    height: int = 400
    hfov_deg: float = 75.0
    camera_height_m: float = 1.7
    truth_range_m: float = 40.0
    """The ground-truth cloud holds what cameras see within this depth."""
    truth_voxel_m: float = 0.05
    """The ground-truth cloud is thinned to one point per voxel of this size."""
    jpeg_quality: int = 92

    def __post_init__(self) -> None:
        """Check ranges."""
        if self.path not in list(PathKind):
            raise ValueError(f"path must be one of {', '.join(PathKind)}, not {self.path!r}")
        for name in ("n_cameras", "n_frames", "frame_spacing_m", "width", "height", "truth_range_m", "truth_voxel_m"):
            if getattr(self, name) <= 0:
                raise ValueError(f"{name} must be positive")
        if not 0 <= self.richness <= 1:
            raise ValueError("richness must be from 0 to 1")
        if not 10 <= self.hfov_deg <= 150:
            raise ValueError("hfov_deg must be from 10 to 150")
        if self.gps_noise_m < 0:
            raise ValueError("gps_noise_m must not be negative")

    @property
    def camera(self) -> Camera:
        """The camera that all positions on the vehicle share."""
        return Camera(self.width, self.height, self.width / 2 / math.tan(math.radians(self.hfov_deg / 2)))


@dataclass(frozen=True)
class StreetTruth:
    """The scene, and where everything is in it."""

    options: StreetOptions
    town: Town
    renderer: TownRenderer
    camera: Camera
    cams_from_rig: list[Pose]
    rigs_from_world: list[Pose]

    def images(self) -> Iterator[tuple[str, Pose]]:
        """Names (``cam0/000000.jpg``) and poses ``cam_from_world`` of all images, camera by camera."""
        for index, cam_from_rig in enumerate(self.cams_from_rig):
            for frame, rig_from_world in enumerate(self.rigs_from_world):
                yield f"cam{index}/{frame:06d}.jpg", cam_from_rig.compose(rig_from_world)

    def seen_surface(self) -> PointCloud:
        """Surface samples with normals that some camera sees within the range, thinned to voxels."""
        parts: list[PointCloud] = []
        for _, pose in self.images():
            depth, normals = self.renderer.depth_map(self.camera, pose)
            rays = self.camera.rays()
            near = (depth > 0) & (depth < self.options.truth_range_m)
            in_camera = (depth[..., None] * rays)[near].astype(np.float64)
            world = (in_camera - pose.translation) @ pose.rotation
            cloud = PointCloud(world.astype(np.float32), normals[near].astype(np.float32))
            parts.append(thin(cloud, self.options.truth_voxel_m))
            if len(parts) > 8:
                parts = [thin(PointCloud.concatenate(parts), self.options.truth_voxel_m)]
        return thin(PointCloud.concatenate(parts), self.options.truth_voxel_m)


def build_street(options: StreetOptions) -> StreetTruth:
    """Build the scene and the drive without rendering anything."""
    length_m = (options.n_frames - 1) * options.frame_spacing_m
    town = build_town(options.path, length_m, options.seed, options.richness)
    return StreetTruth(
        options,
        town,
        TownRenderer(town, options.seed, options.richness),
        options.camera,
        rig_cameras(options.n_cameras),
        rig_poses(town, options.n_frames, options.frame_spacing_m, options.camera_height_m, options.seed),
    )


def _quaternion_xyzw(rotation: NDArray[np.float64]) -> list[float]:
    return [float(value) for value in pycolmap.Rotation3d(rotation).quat]


def _write_rig(path: Path, truth: StreetTruth) -> None:
    """Write the cameras in COLMAP's rig_config format; rotations are w, x, y, z."""
    cameras: list[dict[str, object]] = []
    for index, pose in enumerate(truth.cams_from_rig):
        entry: dict[str, object] = {"image_prefix": f"cam{index}/"}
        if index == 0:
            entry["ref_sensor"] = True
        else:
            x, y, z, w = _quaternion_xyzw(pose.rotation)
            entry["cam_from_rig_rotation"] = [w, x, y, z]
            entry["cam_from_rig_translation"] = pose.translation.tolist()
        entry |= {"camera_model_name": "PINHOLE", "camera_params": list(truth.camera.params)}
        cameras.append(entry)
    path.write_text(json.dumps([{"cameras": cameras}], indent=1) + "\n", encoding="utf-8")


def _write_gps(path: Path, truth: StreetTruth) -> None:
    """Write a noisy position of cam0 for each frame."""
    noise = np.random.default_rng([truth.options.seed, 2]).standard_normal((len(truth.rigs_from_world), 3))
    centers = np.stack([pose.center for pose in truth.rigs_from_world])
    measured = centers + truth.options.gps_noise_m * noise * [1.0, 1.0, 1.5]
    fixes = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84).enu_to_ellipsoid(measured, *ORIGIN_LAT_LON_ALT)
    rows = [f"{frame:06d},{lat:.9f},{lon:.9f},{alt:.3f}" for frame, (lat, lon, alt) in enumerate(fixes)]
    path.write_text("\n".join(["frame,lat,lon,alt", *rows]) + "\n", encoding="utf-8")


def _write_poses(folder: Path, truth: StreetTruth) -> None:
    """Write poses_gt.txt and poses_gt.json."""
    lines = []
    for frame, pose in enumerate(truth.rigs_from_world):
        values = [*pose.center, *_quaternion_xyzw(pose.rotation.T)]
        lines.append(f"{frame} " + " ".join(f"{value:.9f}" for value in values))
    (folder / "poses_gt.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    entries = [
        json.dumps(
            {
                "image": name,
                "R": pose.rotation.round(9).tolist(),
                "t": pose.translation.round(6).tolist(),
                "C": pose.center.round(6).tolist(),
            }
        )
        for name, pose in truth.images()
    ]
    (folder / "poses_gt.json").write_text("[" + ",\n".join(entries) + "]\n", encoding="utf-8")


def _write_mesh(path: Path, town: Town) -> None:
    """Write the town's triangles as a binary PLY file."""
    vertices, triangles = town.mesh.welded()
    faces = np.empty(len(triangles), dtype=[("n", "u1"), ("corners", "<i4", 3)])
    faces["n"], faces["corners"] = 3, triangles
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    path.write_bytes(header.encode("ascii") + vertices.astype("<f4").tobytes() + faces.tobytes())


def render_street(
    folder: Path, options: StreetOptions, *, with_depth: bool = False, with_cloud: bool = True
) -> StreetTruth:
    """Render a drive into a folder.

    Args:
        folder: Created if need be.
        options: What to render.
        with_depth: Also write ``depth/cam0/000000.npy`` ..., float32 (H, W): depth along the camera's z in metres at
            the pixel centres, 0 where there is only sky.
        with_cloud: Also write gt.ply and gt_mesh.ply.

    Returns:
        The scene with its ground truth; its methods cast further rays.
    """
    truth = build_street(options)
    for name, pose in truth.images():
        image_path = folder / "images" / name
        image_path.parent.mkdir(parents=True, exist_ok=True)
        _, data = cv2.imencode(
            ".jpg", truth.renderer.image(truth.camera, pose), [cv2.IMWRITE_JPEG_QUALITY, options.jpeg_quality]
        )
        image_path.write_bytes(data.tobytes())
        if with_depth:
            depth_path = (folder / "depth" / name).with_suffix(".npy")
            depth_path.parent.mkdir(parents=True, exist_ok=True)
            np.save(depth_path, truth.renderer.depth_map(truth.camera, pose)[0])
    _write_rig(folder / "rig.json", truth)
    _write_gps(folder / "gps.csv", truth)
    _write_poses(folder, truth)
    if with_cloud:
        write_ply(folder / "gt.ply", truth.seen_surface())
        _write_mesh(folder / "gt_mesh.ply", truth.town)
    facts = {
        "options": asdict(options),
        "camera": {"model": "PINHOLE", "width": options.width, "height": options.height, "params": truth.camera.params},
        "origin_lat_lon_alt": ORIGIN_LAT_LON_ALT,
        "plain_wall_share": round(truth.town.plain_share, 3),
    }
    (folder / "truth.json").write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
    return truth


def main(
    out: Annotated[Path, typer.Argument(help="Folder to write.")],
    seed: Annotated[int, typer.Option(help="Same seed, same town.")] = 7,
    path: Annotated[PathKind, typer.Option(help="Shape of the drive.")] = PathKind.CORNER,
    cameras: Annotated[int, typer.Option(min=1, max=12, help="Cameras on the vehicle.")] = 3,
    frames: Annotated[int, typer.Option(min=1, help="Frames per camera.")] = 20,
    frame_spacing_m: Annotated[float, typer.Option(min=0.01, help="Distance between frames.")] = 1.5,
    richness: Annotated[float, typer.Option(min=0.0, max=1.0, help="Texture: 0 plain, 1 rich.")] = 1.0,
    gps_noise_m: Annotated[float, typer.Option(min=0.0, help="Standard deviation, horizontally.")] = 0.3,
    width: Annotated[int, typer.Option(min=16, help="Pixels.")] = 640,
    height: Annotated[int, typer.Option(min=16, help="Pixels.")] = 400,
    truth_range_m: Annotated[float, typer.Option(min=0.1, help="How far gt.ply reaches from the cameras.")] = 40.0,
    truth_voxel_m: Annotated[float, typer.Option(min=0.005, help="Spacing of gt.ply.")] = 0.05,
    jpeg_quality: Annotated[int, typer.Option(min=1, max=100)] = 92,
    depth: Annotated[bool, typer.Option(help="Also write exact depth maps.")] = False,
) -> None:
    """Render a drive through a procedural town, with exact ground truth."""
    options = StreetOptions(
        seed=seed,
        path=path,
        n_cameras=cameras,
        n_frames=frames,
        frame_spacing_m=frame_spacing_m,
        richness=richness,
        gps_noise_m=gps_noise_m,
        width=width,
        height=height,
        truth_range_m=truth_range_m,
        truth_voxel_m=truth_voxel_m,
        jpeg_quality=jpeg_quality,
    )
    render_street(out, options, with_depth=depth)


if __name__ == "__main__":
    typer.run(main)
