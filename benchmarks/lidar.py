"""Judge a run by LiDAR scans.

    python -m benchmarks.lidar WORKSPACE CLOUD.ply POSITIONS.json LIDAR.npz

POSITIONS holds `{image name: [x, y, z]}` of true camera positions, LIDAR an array `xyz` (N, 3), both in one metric
frame. The cloud is moved there by the rigid motion, and the similarity, that fit the cameras best. LiDAR scans are
sparse and see less than the cameras. Accuracy counts only those points of the cloud that lie within 50 cm of a LiDAR
point, and their share is printed; completeness counts LiDAR points within a range of the cameras.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from app.scene.read_model import read_posed_scene
from benchmarks.alignment import fit_rigid, fit_similarity, moved, position_errors
from benchmarks.machine import describe_machine
from fusion.cloud import PointCloud, read_ply
from fusion.compare import cloud_distances
from fusion.thinning import thin

_NEAR_LIDAR_M = 0.5
_THRESHOLDS_M = (0.05, 0.1, 0.2, 0.5)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("cloud", type=Path)
    parser.add_argument("positions", type=Path)
    parser.add_argument("lidar", type=Path)
    parser.add_argument("--range-m", type=float, default=25.0)
    arguments = parser.parse_args()
    print(describe_machine(), end="\n\n")
    scene = read_posed_scene(arguments.workspace / "georegister" / "model")
    truth = json.loads(arguments.positions.read_text(encoding="utf-8"))
    known = np.array([name in truth for name in scene.image_names])
    expected = np.array([truth[name] for name in scene.image_names if name in truth])
    print(f"registered images   {len(scene.image_names)} of {len(truth)}")
    cloud = read_ply(arguments.cloud)
    scans = thin(PointCloud(np.load(arguments.lidar)["xyz"].astype(np.float32)), 0.05).points
    scans = scans[cloud_distances(scans, expected.astype(np.float32)) <= arguments.range_m]
    for name, fit in (("rigid fit", fit_rigid), ("similarity fit", fit_similarity)):
        motion = fit(scene.centers_in_world[known], expected)
        errors = 100 * position_errors(scene.centers_in_world[known], expected, motion)
        print(f"\n{name}: position error median {np.median(errors):.1f} cm, 95 % {np.percentile(errors, 95):.1f} cm")
        _score(thin(moved(cloud, motion), 0.05).points, scans)


def _score(cloud: NDArray[np.float32], scans: NDArray[np.float32]) -> None:
    to_lidar, to_cloud = cloud_distances(cloud, scans), cloud_distances(scans, cloud)
    near = to_lidar <= _NEAR_LIDAR_M
    print(f"points in 5 cm voxels: cloud {len(cloud):,}, LiDAR {len(scans):,}")
    print(
        f"of the cloud within {_NEAR_LIDAR_M:g} m of LiDAR {100 * near.mean():.1f} %; their median distance "
        f"{100 * np.median(to_lidar[near]):.1f} cm"
    )
    print("within               " + "".join(f"{100 * t:>8g} cm" for t in _THRESHOLDS_M))
    print("accuracy             " + "".join(f"{100 * (to_lidar[near] <= t).mean():>9.1f} %" for t in _THRESHOLDS_M))
    print("completeness         " + "".join(f"{100 * (to_cloud <= t).mean():>9.1f} %" for t in _THRESHOLDS_M))


if __name__ == "__main__":
    main()
