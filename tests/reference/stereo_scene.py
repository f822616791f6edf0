"""One reference view and its source views, as the PatchMatch kernels take them and as their plain twins do."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mvs_backends.patchmatch.cost import kernels as cost
from mvs_backends.patchmatch.geometry import LevelCamera, warp
from mvs_backends.patchmatch.options import PatchMatchOptions
from mvs_backends.patchmatch.search import window
from tests.reference import patchmatch as plain
from tests.reference.plane_scene import texture

WIDTH, HEIGHT, NUM_SOURCES = 40, 32, 3
OPTIONS = PatchMatchOptions()
WINDOW = window(OPTIONS)
SIGMAS = OPTIONS.sigma_space_px, OPTIONS.sigma_grey


@dataclass
class Scene:
    reference: plain.Camera
    sources: list[plain.Camera]
    maps: NDArray[np.float32]
    """(N, H, W, 3) a plane per pixel of each source; 0 where unknown."""
    kernel_reference: cost.Reference
    kernel_sources: cost.Sources


def grey_image(rng: np.random.Generator) -> NDArray[np.uint8]:
    """Squares and noise."""
    coarse = rng.uniform(60, 190, (HEIGHT // 4 + 2, WIDTH // 4 + 2))
    fine = np.kron(coarse, np.ones((4, 4)))[:HEIGHT, :WIDTH] + rng.uniform(-12, 12, (HEIGHT, WIDTH))
    return fine.astype(np.uint8)


def planes_near(rng: np.random.Generator, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Random planes about 5 away, mildly slanted."""
    w = 1 / rng.uniform(4.5, 5.5, shape)
    slopes = rng.uniform(-0.003, 0.003, (*shape, 2))
    return np.concatenate([w[..., None], slopes], axis=-1).astype(np.float32)


def random_cameras(rng: np.random.Generator, reach: float) -> list[plain.Camera]:
    """The reference and sources up to `reach` beside it, without images."""
    calibration = np.array([[45.0, 0, WIDTH / 2], [0, 44.0, HEIGHT / 2], [0, 0, 1]])
    cameras = []
    for i in range(NUM_SOURCES + 1):
        angles = rng.uniform(-0.03, 0.03, 3)
        turn = np.array([[0, -angles[2], angles[1]], [angles[2], 0, -angles[0]], [-angles[1], angles[0], 0]])
        rotation, _ = np.linalg.qr(np.eye(3) + turn)
        rotation *= np.sign(np.diag(rotation))
        shift = rng.uniform(-reach, reach, 3) if i else np.zeros(3)
        pose = np.concatenate([rotation, shift[:, None]], axis=1)
        cameras.append(plain.Camera(calibration=calibration, pose=pose, grey=np.zeros((HEIGHT, WIDTH), np.uint8)))
    return cameras


def scene(seed: int) -> Scene:
    """Views of nothing in common, and random maps."""
    rng = np.random.default_rng(seed)
    cameras = random_cameras(rng, 0.4)
    for camera in cameras:
        camera.grey = grey_image(rng)
    maps = planes_near(rng, (NUM_SOURCES, HEIGHT, WIDTH))
    maps[rng.random(maps.shape[:3]) < 0.1] = 0
    return _for_kernels(cameras, maps)


def wall_scene(seed: int, *, ahead: bool = False, reach: float = 0.5) -> tuple[Scene, NDArray[np.float64]]:
    """Views of a slanted wall about 5 away, the last perhaps from straight ahead, and maps that lie near it.

    The wall's right half has no texture:

        | texture |  bare  |
        | texture |  shade |

    Returns:
        The scene and (H, W, 3) the wall's plane at each pixel of the reference.
    """
    rng = np.random.default_rng(seed)
    cameras = random_cameras(rng, reach)
    if ahead:
        cameras[-1].pose[:, 3] = 0.0, 0.0, -1.0
    normal, offset = np.array([0.3, -0.2, 1.0]), 5.0
    planes = []
    for camera in cameras:
        rotation, translation = camera.pose[:, :3], camera.pose[:, 3]
        # normal . X = offset in the camera's frame, so that the inverse depth of a ray r is normal . r / offset.
        in_camera = rotation @ normal / (offset + rotation @ normal @ translation)
        columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
        rays = np.stack([columns, rows, np.ones((HEIGHT, WIDTH))], axis=-1) @ np.linalg.inv(camera.calibration).T
        inverse_depth = rays @ in_camera
        slopes = in_camera[:2] / np.diag(camera.calibration)[:2]
        planes.append(np.concatenate([inverse_depth[..., None], np.tile(slopes, (HEIGHT, WIDTH, 1))], axis=-1))
        points = (rays / inverse_depth[..., None] - translation) @ rotation
        grey = texture(points, seed, 1.0)
        x, y = points[..., 0], points[..., 1]
        grey[(x > 0.2) & (y < 0)] = 128
        grey[(x > 0.2) & (y >= 0)] = (100 + 30 * x)[(x > 0.2) & (y >= 0)]
        camera.grey = np.clip(np.round(grey), 0, 255).astype(np.uint8)
    maps = np.stack(planes[1:]) * rng.normal(1, 0.003, (NUM_SOURCES, HEIGHT, WIDTH, 1))
    maps[rng.random(maps.shape[:3]) < 0.1] = 0
    return _for_kernels(cameras, maps.astype(np.float32)), planes[0]


def _for_kernels(cameras: list[plain.Camera], maps: NDArray[np.float32]) -> Scene:
    calibration = cameras[0].calibration
    levels = [LevelCamera(width=WIDTH, height=HEIGHT, calibration=calibration, cam_from_world=c.pose) for c in cameras]
    packed = np.empty((NUM_SOURCES, HEIGHT * WIDTH), np.uint32)
    for camera, out in zip(cameras[1:], packed, strict=True):
        cost.pack_neighbours(camera.grey, out)
    to_source = np.stack([warp(level, levels[0]) for level in levels[1:]])
    size = WIDTH * HEIGHT
    sources = cost.Sources(
        warp=to_source,
        texels=packed.ravel(),
        first=np.arange(NUM_SOURCES).astype(np.uint64) * np.uint64(size),
        width=np.full(NUM_SOURCES, WIDTH, np.int32),
        height=np.full(NUM_SOURCES, HEIGHT, np.int32),
        limit=np.tile(np.array([WIDTH - 1.01, HEIGHT - 1.01], np.float32), (NUM_SOURCES, 1)),
        planes=maps.reshape(-1, 3),
        warp_back=np.stack([warp(levels[0], level) for level in levels[1:]]),
    )
    reference = cost.Reference(
        padded_grey=np.pad(cameras[0].grey, cost.PADDING, mode="edge"),
        inverse_range=np.tile(np.array([0.15, 0.3], np.float32), (HEIGHT, WIDTH, 1)),
        intrinsics=np.array([45.0, 44.0, WIDTH / 2, HEIGHT / 2], np.float32),
    )
    return Scene(cameras[0], cameras[1:], maps, reference, sources)
