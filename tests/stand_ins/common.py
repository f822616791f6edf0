"""What the stand-ins for programs share: the scene, checks of their input by it, and faults.

The scene is the plane `PLANE = nx ny nz offset` of the environment. `FAULT` names what is to go wrong: `exit`, `hang`,
`kill` (after the first result), `partial` (the last result isn't whole), `garbage` (results are noise), `foreign` (they
are of another job) or `wrong` (they are wrong).
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

FAULT = os.environ.get("FAULT", "")
PLANE = np.array([float(value) for value in os.environ["PLANE"].split()])
_MIN_OVERLAP, _MAX_GREY_ERROR = 0.3, 1.5


def fail(message: str) -> None:
    """End as a program that was given nonsense."""
    print(message, flush=True)
    sys.exit(1)


def begin(message: str) -> None:
    """End with a message, or never, if that is the fault."""
    if FAULT == "exit":
        fail(message)
    if FAULT == "hang":
        time.sleep(600)


def write_result(path: Path, data: bytes, *, is_last: bool) -> None:
    """Write as programs do that don't look whether it worked: on a full disk the file is cut short."""
    if FAULT == "garbage":
        data = data[:2] + np.random.default_rng(0).bytes(len(data) - 2)
    with contextlib.suppress(OSError):
        path.write_bytes(data[: len(data) // 2 if FAULT == "partial" and is_last else None])
    if FAULT == "kill":
        os.kill(os.getpid(), signal.SIGKILL)


@dataclass(frozen=True, kw_only=True)
class PinholeImage:
    """An image and its camera, as a program read them."""

    grey: np.ndarray
    """(H, W)"""
    calibration: np.ndarray
    """(3, 3)"""
    rotation: np.ndarray
    translation: np.ndarray
    """Of cam_from_world."""
    first_px: float
    """Where the program has the centre of the top-left pixel, in x and y."""

    @property
    def center(self) -> np.ndarray:
        """(3,) in the world."""
        return -self.rotation.T @ self.translation

    def rays(self) -> np.ndarray:
        """(H, W, 3) in the camera's frame, with z = 1."""
        rows, columns = np.mgrid[: self.grey.shape[0], : self.grey.shape[1]] + self.first_px
        return np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(self.calibration).T

    def depth(self) -> np.ndarray:
        """(H, W) true depth."""
        depth = (PLANE[3] - PLANE[:3] @ self.center) / (self.rays() @ self.rotation @ PLANE[:3])
        return depth * (2.0 if FAULT == "wrong" else 1.0)

    def normal_in_world(self) -> np.ndarray:
        """(3,) towards the camera."""
        return PLANE[:3] if PLANE[:3] @ self.center > PLANE[3] else -PLANE[:3]


def check_pair(reference: PinholeImage, source: PinholeImage) -> None:
    """The plane must look the same in both images, if their cameras are right."""
    in_world = (reference.rays() * reference.depth()[..., None] - reference.translation) @ reference.rotation
    pixels = (in_world @ source.rotation.T + source.translation) @ source.calibration.T
    maps = (pixels[..., :2] / pixels[..., 2:] - source.first_px).astype(np.float32)
    warped = cv2.remap(
        source.grey.astype(np.float32), maps[..., 0], maps[..., 1], cv2.INTER_CUBIC, borderValue=float("nan")
    )
    known = np.isfinite(warped)
    error = np.abs(warped[known] - reference.grey[known]).mean() if known.any() else np.inf
    if FAULT != "wrong" and (known.mean() < _MIN_OVERLAP or error > _MAX_GREY_ERROR):
        fail(f"images and cameras don't agree: {error:.2f} grey values over {known.mean():.0%} of the pixels")
