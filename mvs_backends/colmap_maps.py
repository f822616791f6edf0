"""Depth and normal maps in COLMAP's own file format."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mvs_backends.base import MvsError, MvsJob
from mvs_backends.depth_range import depth_range
from mvs_backends.masks import read_mask


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

    Raises:
        OSError: they can't be written.
    """
    paths = job.normal_map_path(view), job.depth_map_path(view)
    partials = [path.with_name(f".{path.name}.partial") for path in paths]
    for partial, path, values in zip(partials, paths, (normal, depth), strict=True):
        partial.parent.mkdir(parents=True, exist_ok=True)
        try:
            write_map(partial, values)
        except OSError as error:
            for leftover in partials:
                leftover.unlink(missing_ok=True)
            raise OSError(error.errno, error.strerror, str(path)) from error
    for partial, path in zip(partials, paths, strict=True):
        partial.replace(path)


def has_maps(job: MvsJob, view: int) -> bool:
    """Whether both maps of a reference view are there."""
    return job.normal_map_path(view).exists() and job.depth_map_path(view).exists()


def read_map(path: Path) -> NDArray[np.float32]:
    """Read a depth map (H, W) or a normal map (H, W, 3).

    Raises:
        OSError: it isn't there.
        ValueError: it isn't whole.
    """
    width, height, depth, data = path.read_bytes().split(b"&", 3)
    planes = np.frombuffer(data, "<f4").reshape(int(depth), int(height), int(width))
    values = planes.transpose(1, 2, 0)
    return np.array(values[..., 0] if planes.shape[0] == 1 else values)


def write_wanted_maps(job: MvsJob, view: int, depth: NDArray[np.float32], normal: NDArray[np.float32]) -> None:
    """Leave what lies in the region, is not masked, and has a depth and a normal.

    Args:
        job: the job.
        view: reference view.
        depth: (H, W) camera z; anything where unknown.
        normal: (H, W, 3) in the camera's frame, of unit length where known.

    Raises:
        MvsError: they aren't of the image's size.
        OSError: they can't be written.
    """
    camera = job.views[view]
    if depth.shape != (camera.height, camera.width) or normal.shape != (*depth.shape, 3):
        sizes = f"{depth.shape[::-1]} and {normal.shape[1::-1]}"
        raise MvsError(f"maps of {camera.name} have {sizes} pixels, its image ({camera.width}, {camera.height})")
    entry, leave = depth_range(camera, job.boxes_in_world, camera.width, camera.height)
    length = np.linalg.norm(normal, axis=-1)
    wanted = np.isfinite(depth) & (depth > 0) & (depth >= entry) & (depth <= leave) & (np.abs(length - 1) < 0.1)
    mask = read_mask(job, view, camera.width, camera.height)
    if mask is not None:
        wanted &= mask
    unit = np.where(wanted[..., None], normal / np.where(wanted, length, 1)[..., None], 0)
    write_maps(job, view, np.where(wanted, depth, 0).astype(np.float32), unit.astype(np.float32))


def write_empty_maps(job: MvsJob, view: int) -> None:
    """Leave maps of a view of which nothing is known."""
    shape = job.views[view].height, job.views[view].width
    write_maps(job, view, np.zeros(shape, np.float32), np.zeros((*shape, 3), np.float32))
