"""Depth and normal maps in COLMAP's own file format."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mvs_backends.base import MvsJob


def write_map(path: Path, values: NDArray[np.float32]) -> None:
    """Write a depth map (H, W) or a normal map (H, W, 3) as COLMAP reads it: one plane after the other.

    Not by `pycolmap.NormalMap.from_array`, which (in 4.2) leaves the three components of each pixel side by side, so
    that COLMAP's fusion finds other normals than were meant.
    """
    planes = np.atleast_3d(values).transpose(2, 0, 1)
    depth, height, width = planes.shape
    header = f"{width}&{height}&{depth}&".encode("ascii")
    path.write_bytes(header + np.ascontiguousarray(planes, dtype="<f4").tobytes())


def write_maps(job: MvsJob, view: int, depth: NDArray[np.float32], normal: NDArray[np.float32]) -> None:
    """Leave a reference view's maps where the job wants them, both or none.

    Args:
        job: the job.
        view: reference view.
        depth: (H, W) camera z, 0 where unknown.
        normal: (H, W, 3) unit length, in the camera's frame, facing the camera.
    """
    paths = job.normal_map_path(view), job.depth_map_path(view)
    partials = [path.with_name(f".{path.name}.partial") for path in paths]
    for partial, values in zip(partials, (normal, depth), strict=True):
        partial.parent.mkdir(parents=True, exist_ok=True)
        write_map(partial, values)
    for partial, path in zip(partials, paths, strict=True):
        partial.replace(path)


def has_maps(job: MvsJob, view: int) -> bool:
    """Whether both maps of a reference view are there."""
    return job.normal_map_path(view).exists() and job.depth_map_path(view).exists()
