"""What a LiDAR scan says about a cloud: its surfaces between the points, and where the scan lies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.alignment import Motion
from fusion.open3d_import import import_open3d

_NEAR_M = 0.5
"""Of a scan's point: what is farther away may be a surface that the LiDAR did not see."""
_NUM_NEIGHBORS = 12
_MAX_ROUGHNESS_M = 0.03
_MIN_WIDTH_M = 0.05
_FIT_RADII_M = (1.0, 0.5, 0.25)


def surface_distances(points: NDArray[np.float32], scan: NDArray[np.float32]) -> NDArray[np.float64]:
    """Distances of points (N, 3) from the surfaces that a scan (M, 3) samples.

    A spinning LiDAR draws rings: close along them, decimetres apart across. A distance from its points would mostly be
    that from the rings. So distances are measured from the plane through the neighbours of the scan's nearest point.

    Returns:
        (N,) metres; NaN where no point of the scan is near, or its neighbours lie on a line or on no plane.
    """
    nearest, distance = _neighbors(points, scan, 1)
    distances = np.full(len(points), np.nan)
    near = np.flatnonzero(distance[:, 0] <= _NEAR_M)
    needed, row = np.unique(nearest[near, 0], return_inverse=True)
    neighbors, _ = _neighbors(scan[needed], scan, min(_NUM_NEIGHBORS, len(scan)))
    offsets = scan[neighbors].astype(np.float64)
    centers = offsets.mean(axis=1)
    offsets -= centers[:, None]
    variances, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", offsets, offsets) / neighbors.shape[1])
    plane = (variances[:, 0] <= _MAX_ROUGHNESS_M**2) & (variances[:, 1] >= _MIN_WIDTH_M**2)
    from_plane = np.abs(np.einsum("ni,ni->n", points[near] - centers[row], axes[row, :, 0]))
    distances[near] = np.where(plane[row], from_plane, np.nan)
    return distances


def fit_scans(scans: Sequence[NDArray[np.float32]], cloud: NDArray[np.float32]) -> list[Motion]:
    """The rigid motion of each scan (M, 3) onto the surfaces of a cloud (N, 3) that it lies less than a metre off.

    Iterated closest points, distances measured along the cloud's normals (Chen & Medioni 1992), large ones counting
    less.
    """
    geometry, registration = import_open3d().geometry, import_open3d().pipelines.registration
    target = geometry.PointCloud(_vectors(cloud))
    target.estimate_normals(geometry.KDTreeSearchParamKNN(20))
    motions = []
    for scan in scans:
        motion = np.eye(4)
        for radius in _FIT_RADII_M:
            method = registration.TransformationEstimationPointToPlane(registration.TukeyLoss(k=radius))
            found = registration.registration_icp(geometry.PointCloud(_vectors(scan)), target, radius, motion, method)
            motion = found.transformation
        motions.append((motion[:3, :3], motion[:3, 3]))
    return motions


def _vectors(points: NDArray[np.float32]) -> Any:
    """Open3D's copy of points."""
    return import_open3d().utility.Vector3dVector(points.astype(np.float64))


def _neighbors(
    query: NDArray[np.float32], target: NDArray[np.float32], count: int
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """(N, count) rows of the nearest points of the target, and their distances."""
    core = import_open3d().core
    search = core.nns.NearestNeighborSearch(core.Tensor.from_numpy(np.ascontiguousarray(target)))
    search.knn_index()
    rows, squared = search.knn_search(core.Tensor.from_numpy(np.ascontiguousarray(query)), count)
    return rows.numpy(), np.sqrt(squared.numpy().astype(np.float64))
