"""The cameras on the vehicle, and how they see the town: ray casting and shading."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sample_data.street_scene import Town
from sample_data.street_texture import albedo, noise_pyramid, sample_noise

Floats = NDArray[np.float64]

_SUN = np.array([-0.52, -0.58, 0.63])
_SUN_LIGHT, _AMBIENT_LIGHT = 0.66, 0.60
_SUPERSAMPLING = 2
_SHADOW_OFFSET_M = 2e-3


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion; pixel centres at .5."""

    width: int
    height: int
    focal_px: float

    @property
    def params(self) -> tuple[float, float, float, float]:
        """COLMAP's PINHOLE parameters: fx, fy, cx, cy."""
        return (self.focal_px, self.focal_px, self.width / 2, self.height / 2)

    def rays(self, supersampling: int = 1) -> NDArray[np.float32]:
        """Directions (H, W, 3) in the camera (x right, y down, z forward) with z = 1."""
        x = (np.arange(self.width * supersampling) + 0.5) / supersampling - self.width / 2
        y = (np.arange(self.height * supersampling) + 0.5) / supersampling - self.height / 2
        grid = np.stack([*np.meshgrid(x / self.focal_px, y / self.focal_px), np.ones((len(y), len(x)))], axis=2)
        return grid.astype(np.float32)


@dataclass(frozen=True)
class Pose:
    """Position of a camera: ``point3D_in_cam = rotation @ point3D_in_world + translation``."""

    rotation: Floats
    """(3, 3), world to camera."""
    translation: Floats
    """(3,)."""

    @property
    def center(self) -> Floats:
        """(3,) projection centre in the world."""
        center: Floats = -self.rotation.T @ self.translation
        return center

    def compose(self, inner: Pose) -> Pose:
        """Return ``self`` applied after ``inner``."""
        return Pose(self.rotation @ inner.rotation, self.rotation @ inner.translation + self.translation)

    def inverse(self) -> Pose:
        """Return the opposite transform."""
        return Pose(self.rotation.T, self.center)


def camera_yaws_deg(n_cameras: int) -> list[float]:
    """Directions of the cameras, left positive: one or a stereo pair forward, then front sides, back, evenly around."""
    known: dict[int, list[float]] = {
        1: [0],
        2: [0, 0],
        3: [0, 55, -55],
        4: [0, 55, -55, 180],
        5: [0, 55, -55, 110, -110],
        6: [0, 55, -55, 110, -110, 180],
    }
    return known.get(n_cameras) or [360 / n_cameras * i for i in range(n_cameras)]


def rig_cameras(n_cameras: int) -> list[Pose]:
    """Poses ``cam_from_rig``; the rig's frame is that of the first camera."""
    vehicle: list[Pose] = []
    for index, yaw_deg in enumerate(camera_yaws_deg(n_cameras)):
        yaw = math.radians(yaw_deg)
        position = np.array([0.35 * math.cos(yaw) - 0.35, 0.45 * math.sin(yaw), -0.04 * min(index, 1)])
        if n_cameras == 2:
            position = np.array([0.0, -0.6 * index, 0.0])
        forward = np.array([math.cos(yaw), math.sin(yaw), 0.0])
        right = np.array([math.sin(yaw), -math.cos(yaw), 0.0])
        rotation = np.stack([right, [0.0, 0.0, -1.0], forward])
        vehicle.append(Pose(rotation, -rotation @ position))
    return [pose.compose(vehicle[0].inverse()) for pose in vehicle]


def rig_poses(town: Town, n_frames: int, spacing_m: float, height_m: float, seed: int) -> list[Pose]:
    """Poses ``rig_from_world`` of all frames: along the path, with the slight sway of a car on its springs."""
    xy, headings = town.plan.path.at(spacing_m * np.arange(n_frames, dtype=np.float64))
    phase = np.random.default_rng([seed, 1]).uniform(0, 2 * math.pi, 3)
    poses = []
    for index in range(n_frames):
        sway = np.sin(np.array([0.9, 1.3, 0.7]) * index + phase)
        roll, pitch = math.radians(0.35) * sway[0], math.radians(0.45) * sway[1]
        heading = headings[index]
        forward = np.array([math.cos(heading) * math.cos(pitch), math.sin(heading) * math.cos(pitch), math.sin(pitch)])
        left = np.array([-math.sin(heading), math.cos(heading), math.sin(roll)])
        left -= forward * (left @ forward)
        left /= np.linalg.norm(left)
        rotation = np.stack([-left, -np.cross(forward, left), forward])
        center = np.array([*xy[index], height_m + 0.012 * sway[2]])
        poses.append(Pose(rotation, -rotation @ center))
    return poses


class TownRenderer:
    """Casts rays into a town."""

    def __init__(self, town: Town, seed: int, richness: float) -> None:
        """Build the ray caster's tree."""
        import open3d as o3d

        self.town = town
        self._seed, self._richness = seed, richness
        self._o3d = o3d
        self._scene = o3d.t.geometry.RaycastingScene(nthreads=0)
        vertices, triangles = town.mesh.welded()
        self._scene.add_triangles(
            o3d.core.Tensor.from_numpy(vertices), o3d.core.Tensor.from_numpy(triangles.astype(np.uint32))
        )

    def cast(self, pose: Pose, rays: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
        """First hits of rays (N, 3), given in the camera with z = 1.

        Returns:
            Arrays ``depth`` (N,) in metres along z, infinite where there is only sky; ``triangle`` (N,); ``uv`` (N, 2)
            barycentric; ``normal`` (N, 3) towards the camera; ``direction`` (N, 3) in the world.
        """
        direction = rays @ pose.rotation.astype(np.float32)
        origin = np.broadcast_to(pose.center.astype(np.float32), direction.shape)
        hits = self._scene.cast_rays(self._o3d.core.Tensor.from_numpy(np.concatenate([origin, direction], axis=1)))
        normal = hits["primitive_normals"].numpy()
        facing = np.einsum("ij,ij->i", normal, direction)
        return {
            "depth": hits["t_hit"].numpy(),
            "triangle": hits["primitive_ids"].numpy(),
            "uv": hits["primitive_uvs"].numpy(),
            "normal": np.where(facing[:, None] > 0, -normal, normal),
            "direction": direction,
        }

    def image(self, camera: Camera, pose: Pose) -> NDArray[np.uint8]:
        """Render a colour image (H, W, 3), blue-green-red as OpenCV keeps it."""
        rays = camera.rays(_SUPERSAMPLING)
        hits = self.cast(pose, rays.reshape(-1, 3))
        seen = np.flatnonzero(np.isfinite(hits["depth"]))
        color = self._sky(hits["direction"])
        color[seen] = self._shade(camera, pose, {name: values[seen] for name, values in hits.items()})
        n = _SUPERSAMPLING
        blocks = color.reshape(camera.height, n, camera.width, n, 3).mean(axis=(1, 3))
        bgr: NDArray[np.uint8] = np.rint(255 * np.clip(blocks, 0, 1)).astype(np.uint8)[..., ::-1]
        return np.ascontiguousarray(bgr)

    def depth_map(self, camera: Camera, pose: Pose) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Exact depth (H, W) at the pixel centres, 0 for sky, and normals (H, W, 3) in the world."""
        hits = self.cast(pose, camera.rays().reshape(-1, 3))
        depth = np.where(np.isfinite(hits["depth"]), hits["depth"], np.float32(0))
        shape = (camera.height, camera.width)
        return depth.reshape(shape), hits["normal"].reshape(*shape, 3)

    def _sky(self, direction: NDArray[np.float32]) -> NDArray[np.float32]:
        """Colour of the sky: a gradient with soft clouds."""
        unit = direction / np.linalg.norm(direction, axis=1, keepdims=True)
        up = np.clip(unit[:, 2], 0, 1)[:, None]
        blue = (1 - up) * np.array([0.80, 0.87, 0.94]) + up * np.array([0.36, 0.56, 0.84])
        flat = (unit[:, :2] / (np.clip(unit[:, 2:], 0, 1) + 0.25) * 6.0).astype(np.float32)
        clouds = sample_noise(noise_pyramid(self._seed), flat, np.full(len(flat), 0.02, dtype=np.float32), 0.02)
        cover = np.clip(0.9 * clouds[:, 2:] + 0.1, 0, 0.75)
        return np.asarray(blue * (1 - cover) + 0.96 * cover, dtype=np.float32)

    def _shade(self, camera: Camera, pose: Pose, hits: dict[str, NDArray[np.float32]]) -> NDArray[np.float32]:
        """Colour of the hits (N, 3) under the sun, with its shadows, and the sky's light."""
        mesh = self.town.mesh
        triangle, depth, normal = hits["triangle"].astype(np.int64), hits["depth"], hits["normal"]
        xyz = pose.center.astype(np.float32) + depth[:, None] * hits["direction"]
        uv_corners = mesh.uv_m[triangle]
        u, v = hits["uv"][:, :1], hits["uv"][:, 1:]
        uv_m = uv_corners[:, 0] * (1 - u - v) + uv_corners[:, 1] * u + uv_corners[:, 2] * v
        unit = hits["direction"] / np.linalg.norm(hits["direction"], axis=1, keepdims=True)
        slant = np.clip(-np.einsum("ij,ij->i", normal, unit), 0.08, 1)
        footprint = depth / np.float32(camera.focal_px) * 0.8 / np.sqrt(slant)
        base = albedo(
            xyz,
            uv_m,
            mesh.surface[triangle],
            footprint,
            surfaces=mesh.surfaces,
            field=self.town.field,
            richness=self._richness,
            seed=self._seed,
        )
        sun = (_SUN / np.linalg.norm(_SUN)).astype(np.float32)
        facing = np.clip(normal @ sun, 0, 1)
        lit = np.flatnonzero(facing > 0)
        starts = xyz[lit] + _SHADOW_OFFSET_M * (1 + 0.1 * depth[lit, None]) * normal[lit]
        shadow_rays = np.concatenate([starts, np.broadcast_to(sun, starts.shape)], axis=1)
        blocked = self._scene.test_occlusions(self._o3d.core.Tensor.from_numpy(shadow_rays)).numpy()
        facing[lit[blocked]] = 0.0
        ambient = _AMBIENT_LIGHT * (0.8 + 0.2 * normal[:, 2])
        light = ambient[:, None] * np.array([0.95, 1.0, 1.08]) + _SUN_LIGHT * facing[:, None] * np.array(
            [1.05, 1.0, 0.92]
        )
        return np.asarray(base * light, dtype=np.float32)
