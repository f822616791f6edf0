"""Stands in for ACMP, ACMH, ACMM and ACMMP: reads their input by their own rules, and writes the truth as they would.

Called by its file name as the program. The scene is the plane `PLANE = nx ny nz offset` of the environment;
`FAULT` names what is to go wrong: exit, abort, hang, partial or garbage.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path

import cv2
import numpy as np

MAX_SIZE = 3200


def fail(message: str) -> None:
    """End as a program that was given nonsense."""
    print(message, flush=True)
    sys.exit(1)


class Tokens:
    """What `std::ifstream >>` sees."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._tokens = path.read_text(encoding="ascii").split()[::-1]

    def word(self, expected: str) -> None:
        """A word that must be there."""
        found = self._tokens.pop()
        if found != expected:
            fail(f"{self._path}: {found} instead of {expected}")

    def floats(self, count: int) -> np.ndarray:
        """Numbers."""
        return np.array([float(self._tokens.pop()) for _ in range(count)])

    def integer(self) -> int:
        """A whole number."""
        return int(self._tokens.pop())

    def end(self) -> None:
        """Nothing may be left."""
        if self._tokens:
            fail(f"{self._path}: {len(self._tokens)} values too many")


class Camera:
    """A camera file and its image."""

    def __init__(self, folder: Path, number: int) -> None:
        tokens = Tokens(folder / "cams" / f"{number:08d}_cam.txt")
        tokens.word("extrinsic")
        extrinsic = tokens.floats(16).reshape(4, 4)
        if not np.array_equal(extrinsic[3], [0, 0, 0, 1]):
            fail("the last row of an extrinsic matrix is not 0 0 0 1")
        self.rotation, self.translation = extrinsic[:3, :3], extrinsic[:3, 3]
        if not np.allclose(self.rotation @ self.rotation.T, np.eye(3), atol=1e-6):
            fail("a rotation is none")
        tokens.word("intrinsic")
        self.calibration = tokens.floats(9).reshape(3, 3)
        self.near, _, _, self.far = tokens.floats(4)
        tokens.end()
        if not 0 < self.near < self.far:
            fail(f"depths from {self.near} to {self.far}")
        path = folder / "images" / f"{number:08d}.jpg"
        self.image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if self.image is None:
            fail(f"{path} can't be read")
        if max(self.image.shape) > MAX_SIZE:
            fail(f"{path} would be reduced")

    def plane_depth(self, plane: np.ndarray) -> np.ndarray:
        """(H, W) depth at pixel centres, which are whole numbers here."""
        height, width = self.image.shape
        pixels = np.stack([*np.meshgrid(np.arange(width), np.arange(height)), np.ones((height, width))], axis=-1)
        rays = pixels @ np.linalg.inv(self.calibration).T @ self.rotation
        center = -self.rotation.T @ self.translation
        return (plane[3] - plane[:3] @ center) / (rays @ plane[:3])

    def points(self, depth: np.ndarray) -> np.ndarray:
        """(H, W, 3) points in the world."""
        height, width = self.image.shape
        pixels = np.stack([*np.meshgrid(np.arange(width), np.arange(height)), np.ones((height, width))], axis=-1)
        return (pixels @ np.linalg.inv(self.calibration).T * depth[..., None] - self.translation) @ self.rotation


def check_pair(reference: Camera, source: Camera, plane: np.ndarray) -> None:
    """The plane must look the same in both images."""
    in_source = reference.points(reference.plane_depth(plane)) @ source.rotation.T + source.translation
    pixels = in_source @ source.calibration.T
    maps = (pixels[..., :2] / pixels[..., 2:]).astype(np.float32)
    warped = cv2.remap(
        source.image.astype(np.float32), maps[..., 0], maps[..., 1], cv2.INTER_CUBIC, borderValue=float("nan")
    )
    known = np.isfinite(warped)
    difference = np.abs(warped[known] - reference.image[known]).mean()
    if known.mean() < 0.3 or difference > 1.0:
        fail(f"images and cameras don't agree: {difference:.2f} grey values over {known.mean():.0%} of the pixels")


def write_dmb(path: Path, values: np.ndarray) -> None:
    """Header and rows, as `writeDepthDmb` and `writeNormalDmb` do."""
    height, width, channels = np.atleast_3d(values).shape
    header = np.array([1, height, width, channels], "<i4").tobytes()
    path.write_bytes(header + np.ascontiguousarray(values, "<f4").tobytes())


def main() -> None:
    """Do what the program does."""
    program, folder, fault = Path(sys.argv[0]).name, Path(sys.argv[1]), os.environ.get("FAULT", "")
    plane = np.array([float(value) for value in os.environ["PLANE"].split()])
    if fault == "exit":
        fail("CUDA driver version is insufficient")
    if fault == "abort":
        os.kill(os.getpid(), signal.SIGABRT)
    if fault == "hang":
        time.sleep(600)
    tokens = Tokens(folder / "pair.txt")
    problems = []
    for expected in range(tokens.integer()):
        number, sources = tokens.integer(), []
        for _ in range(tokens.integer()):
            source, score = tokens.integer(), tokens.floats(1)[0]
            if score > 0:
                sources.append(source)
        if number != expected or not sources or number in sources:
            fail(f"pair.txt: image {number} at place {expected} with sources {sources}")
        problems.append(sources)
    tokens.end()
    cameras = [Camera(folder, number) for number in range(len(problems))]
    (folder / program).mkdir(exist_ok=True)
    for number, sources in enumerate(problems):
        camera = cameras[number]
        for source in sources:
            check_pair(camera, cameras[source], plane)
        depth = camera.plane_depth(plane)
        depth[(depth < 0.6 * camera.near) | (depth > 1.2 * camera.far)] = 0.0
        toward = plane[:3] if (camera.rotation @ plane[:3])[2] < 0 else -plane[:3]
        result = folder / program / f"2333_{number:08d}"
        result.mkdir()
        if fault == "partial" and number == len(problems) - 1:
            break
        for name in ("depths.dmb", "depths_geom.dmb"):
            write_dmb(result / name, depth[:-1] if fault == "garbage" else depth)
        write_dmb(result / "normals.dmb", np.broadcast_to(toward, (*depth.shape, 3)))


if __name__ == "__main__":
    main()
