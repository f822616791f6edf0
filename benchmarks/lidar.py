"""Judge a run by LiDAR scans.

    python -m benchmarks.lidar WORKSPACE CLOUD.ply POSES.json LIDAR.npz

POSES holds `{image name: world_from_cam}` of the true cameras, 3x4 matrices of a rotation and a position, LIDAR an
array `xyz` (N, 3), both in one metric frame, and for several scans an array `scan` (N,) with the number of each
point's. The cloud is moved there by the cameras' mean rotation and the translation, and in the similarity fit the
scale, that fit their positions best. After the rigid fit each scan is also moved onto the cloud by itself, which leaves
the errors of stereo and of scale: not how the poses drift, nor how badly a GPS placed the scans beside each other.

LiDAR scans are sparse and see less than the cameras. Accuracy counts those points of the cloud that lie within 50 cm of
a LiDAR point where the scan samples a plane, and is the distance from that; their share is printed. Completeness counts
LiDAR points within a range of the cameras.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from app.scene.read_model import read_posed_scene
from benchmarks.alignment import fit_rigid, fit_similarity, mean_rotation, moved, position_errors
from benchmarks.lidar_scan import fit_scans, surface_distances
from benchmarks.machine import describe_machine
from fusion.cloud import PointCloud, read_ply
from fusion.compare import cloud_distances
from fusion.thinning import thin

_VOXEL_M = 0.05
_THRESHOLDS_M = (0.05, 0.1, 0.2, 0.5)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("cloud", type=Path)
    parser.add_argument("poses", type=Path)
    parser.add_argument("lidar", type=Path)
    parser.add_argument("--range-m", type=float, default=25.0)
    arguments = parser.parse_args()
    print(describe_machine(), end="\n\n")
    scene = read_posed_scene(arguments.workspace / "georegister" / "model")
    truth = json.loads(arguments.poses.read_text(encoding="utf-8"))
    known = np.array([name in truth for name in scene.image_names])
    expected = np.array([truth[name] for name in scene.image_names if name in truth])
    turns, positions = expected[:, :, :3], expected[:, :, 3]
    found_turns, found_positions = scene.cam_from_world[known, :, :3].transpose(0, 2, 1), scene.centers_in_world[known]
    rotation = mean_rotation(found_turns, turns)
    print(f"registered images   {len(scene.image_names)} of {len(truth)}")
    print(
        f"rotation error median {np.median(_angles_deg(turns.transpose(0, 2, 1) @ rotation @ found_turns)):.2f} degrees"
    )
    found = read_ply(arguments.cloud)
    scans = _scans(arguments.lidar, positions.astype(np.float32), arguments.range_m)
    for name, fit in (("rigid fit", fit_rigid), ("similarity fit", fit_similarity)):
        motion = fit(found_positions, positions, rotation)
        errors = 100 * position_errors(found_positions, positions, motion)
        scale = np.cbrt(np.linalg.det(motion[0]))
        print(f"\n{name}, scale {scale:.4f}: position error median {np.median(errors):.1f} cm, ", end="")
        print(f"95 % {np.percentile(errors, 95):.1f} cm")
        cloud = thin(moved(found, motion), _VOXEL_M).points
        _print_scores(cloud, scans)
        if fit is fit_rigid:
            print("\neach scan moved onto the cloud after the rigid fit")
            _print_scores(cloud, _moved_scans(scans, cloud))


def _angles_deg(rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """(...) angles of rotations (..., 3, 3)."""
    cosines = (np.trace(rotations, axis1=-2, axis2=-1) - 1) / 2
    angles: NDArray[np.float64] = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
    return angles


def _scans(file: Path, positions: NDArray[np.float32], range_m: float) -> list[NDArray[np.float32]]:
    """Each scan's points within a range of the cameras, thinned."""
    with np.load(file) as arrays:
        points = arrays["xyz"].astype(np.float32)
        numbers = arrays["scan"] if "scan" in arrays else np.zeros(len(points), dtype=np.int64)
    scans = [thin(PointCloud(points[numbers == number]), _VOXEL_M).points for number in np.unique(numbers)]
    return [scan[cloud_distances(scan, positions) <= range_m] for scan in scans]


def _moved_scans(scans: list[NDArray[np.float32]], cloud: NDArray[np.float32]) -> list[NDArray[np.float32]]:
    """Each scan on the cloud by itself."""
    found = []
    for scan, (rotation, translation) in zip(scans, fit_scans(scans, cloud), strict=True):
        found.append((scan @ rotation.T + translation).astype(np.float32))
        shift = np.linalg.norm(found[-1].mean(axis=0) - scan.mean(axis=0))
        print(f"  a scan of {len(scan):,} points by {100 * shift:.0f} cm and {_angles_deg(rotation):.2f} degrees")
    return found


def _print_scores(cloud: NDArray[np.float32], scans: list[NDArray[np.float32]]) -> None:
    """Of all pairs of a scan and a point of the cloud near it, and of all points of the scans."""
    from_surface = np.stack([surface_distances(cloud, scan) for scan in scans])
    to_cloud = np.concatenate([cloud_distances(scan, cloud) for scan in scans])
    judged = from_surface[np.isfinite(from_surface)]
    share = np.isfinite(from_surface).any(axis=0).mean()
    print(f"points in 5 cm voxels: cloud {len(cloud):,}, LiDAR {len(to_cloud):,}")
    print(f"of the cloud {100 * share:.1f} % near a plane of LiDAR; median {100 * np.median(judged):.1f} cm")
    print("within               " + "".join(f"{100 * t:>8g} cm" for t in _THRESHOLDS_M))
    print("accuracy             " + "".join(f"{100 * (judged <= t).mean():>9.1f} %" for t in _THRESHOLDS_M))
    print("completeness         " + "".join(f"{100 * (to_cloud <= t).mean():>9.1f} %" for t in _THRESHOLDS_M))


if __name__ == "__main__":
    main()
