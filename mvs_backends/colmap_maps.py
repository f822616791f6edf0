"""Depth and normal maps in COLMAP's own file format."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray


def write_map(path: Path, values: NDArray[np.float32]) -> None:
    """Write a depth map (H, W) or a normal map (H, W, 3) as COLMAP reads it: one plane after the other.

    Not by `pycolmap.NormalMap.from_array`, which (in 4.2) leaves the three components of each pixel side by side, so
    that COLMAP's fusion finds other normals than were meant.
    """
    planes = np.atleast_3d(values).transpose(2, 0, 1)
    depth, height, width = planes.shape
    header = f"{width}&{height}&{depth}&".encode("ascii")
    path.write_bytes(header + np.ascontiguousarray(planes, dtype="<f4").tobytes())
