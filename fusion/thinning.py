"""One point per voxel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusion.cloud import PointCloud
from fusion.errors import FusionError


def voxel_keys(points: NDArray[np.float32], voxel_m: float) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Number the voxels that points (N, 3) lie in; the grid starts at the coordinates' origin.

    Returns:
        One number per point (N,), equal for equal voxels only and rising with x, y, z; squared distances (N,) from the
        voxels' centres in units of a voxel's size.

    Raises:
        FusionError: So many voxels can't be numbered.
    """
    scaled = points.astype(np.float64) / voxel_m
    index = np.floor(scaled)
    offset = ((scaled - index - 0.5) ** 2).sum(axis=1)
    low = index.min(axis=0)
    size = index.max(axis=0) - low + 1
    if size.prod() >= 2**62:
        raise FusionError(f"voxels of {voxel_m:g} m are too small for a cloud of this extent; choose larger ones")
    cell = (index - low).astype(np.int64)
    _, n_y, n_z = size.astype(np.int64)
    return (cell[:, 0] * n_y + cell[:, 1]) * n_z + cell[:, 2], offset


def thin(cloud: PointCloud, voxel_m: float) -> PointCloud:
    """Keep in each voxel the point nearest its centre; sorted by voxel.

    The points kept, and their order, do not depend on the order of the cloud.

    Args:
        cloud: What to thin.
        voxel_m: Size of a voxel.
    """
    if len(cloud) == 0:
        return cloud
    keys, offset = voxel_keys(cloud.points, voxel_m)
    order = np.argsort(keys, kind="stable")
    starts = np.flatnonzero(np.diff(keys[order], prepend=-1))
    counts = np.diff(starts, append=len(order))
    nearest = np.repeat(np.minimum.reduceat(offset[order], starts), counts)
    candidates = order[offset[order] == nearest]
    x, y, z = cloud.points[candidates].T
    candidates = candidates[np.lexsort((z, y, x, keys[candidates]))]
    return cloud.select(candidates[np.flatnonzero(np.diff(keys[candidates], prepend=-1))])
