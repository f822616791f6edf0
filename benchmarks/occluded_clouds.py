"""What `--visibility occluded` does to the dense cloud: views, time and quality with both kinds, side by side.

    python -m benchmarks.occluded_clouds WORK [--seed 7] [--clusters x0002_y0003 ...]

A rendered lap around a block of houses (`benchmarks.visibility` measures what is visible there): two parallel streets,
44 m apart, with the houses between them. True poses, and the sparse model of `benchmarks.sparse_street`. By default a
strip of three clusters across both streets and the houses, and the corner whose selection changes most. WORK is a
folder to work in.

Time is CPU-seconds, user and system, of the stereo of all clusters, one thread, kernels compiled before. Scores are
accuracy / completeness / F in %, both sides thinned to 5 cm voxels, accuracy to the mesh; the truth is what some image
of the drive sees within 40 m in the cells of the clusters.
"""

from __future__ import annotations

import argparse
import shutil
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap

from app.clustering.clusters import Cluster, cluster_views
from app.clustering.options import BlockVisibility, ClusteringOptions
from app.dense_job import prepare_workspace, write_dense_job
from app.options import DensifyOptions
from app.scene.point_index import PointIndex
from app.scene.posed_scene import PosedScene
from app.view_selection.options import SelectionOptions, Visibility
from app.view_selection.problem import ProblemCutter
from app.view_selection.selection import select_views
from benchmarks.machine import describe_machine
from benchmarks.sparse_street import sparse_street
from fusion.cloud import PointCloud, read_ply
from fusion.compare import CompareOptions, compare_clouds
from fusion.depth_fusion import FusionOptions, fuse_depth_maps
from fusion.merge import crop_cloud
from mvs_backends import get_backend
from mvs_backends.base import MvsOptions
from sample_data.render_street import StreetOptions, render_street
from sample_data.street_path import PathKind

STREET = StreetOptions(path=PathKind.LOOP, n_frames=37, frame_spacing_m=4.5, n_cameras=4, width=384, height=240)
CLUSTERS = ("x0002_y0003", "x0003_y0003", "x0004_y0003", "x0004_y0001")
THRESHOLDS_M = (0.05, 0.1, 0.2)


def main() -> None:
    """Print one row per kind of visibility, for all clusters together and for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--seed", type=int, default=7, help="of the town")
    parser.add_argument("--clusters", nargs="+", default=CLUSTERS)
    arguments = parser.parse_args()
    work: Path = arguments.work
    print(describe_machine(), end="\n\n")
    truth = render_street(work / "street", replace(STREET, seed=arguments.seed))
    scene = sparse_street(truth, arguments.seed).scene
    camera = pycolmap.Camera(
        model="PINHOLE", width=truth.camera.width, height=truth.camera.height, params=list(truth.camera.params)
    )
    get_backend("patchmatch").prepare()
    thresholds = " | ".join(f"{100 * t:g} cm" for t in THRESHOLDS_M)
    print(f"| cluster | visibility | images | selected | CPU-s | points | {thresholds} |", "|---" * 9 + "|", sep="\n")
    for kind in Visibility.FRUSTUM, Visibility.OCCLUDED:
        clusters = cluster_views(scene, ClusteringOptions(visibility=BlockVisibility(kind))).clusters
        chosen = [cluster for cluster in clusters if cluster.name in arguments.clusters]
        found = [_reconstruct(work, scene, camera, cluster, kind) for cluster in chosen]
        for row in range(len(chosen)):
            _print_row(chosen[row : row + 1], kind, found[row : row + 1], work / "street")
        _print_row(chosen, kind, found, work / "street")


def _reconstruct(
    work: Path, scene: PosedScene, camera: pycolmap.Camera, cluster: Cluster, kind: Visibility
) -> tuple[int, float, PointCloud]:
    """How many views are selected, the CPU-seconds of stereo, and the cloud in the cluster's cells."""
    options = SelectionOptions(visibility=kind)
    names = select_views(ProblemCutter(scene).problem(cluster, kind), options).image_names
    folder = work / kind / cluster.name
    shutil.rmtree(folder, ignore_errors=True)
    write_dense_job(
        folder / "job",
        scene=scene,
        points=PointIndex(scene.points_in_world),
        image_rows=scene.image_names.rows_of(names),
        region=cluster.region(),
        cameras=[camera],
        digests={},
    )
    job = prepare_workspace(
        folder / "job",
        folder / "dense",
        image_root=work / "street" / "images",
        mask_root=None,
        options=DensifyOptions(),
    )
    started = time.process_time()
    get_backend("patchmatch").estimate(job=job, options=MvsOptions(), num_threads=1)
    stereo_s = time.process_time() - started
    boxes = cluster.region().padded_boxes()
    bounds = np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])
    cloud = fuse_depth_maps(folder / "dense", folder / "scratch.ply", options=FusionOptions(), bounds=bounds)
    return len(names), stereo_s, crop_cloud(cloud, cluster.region())


def _print_row(
    clusters: list[Cluster], kind: Visibility, found: list[tuple[int, float, PointCloud]], truth: Path
) -> None:
    num_selected, stereo_s, clouds = zip(*found, strict=True)
    cloud, reference = PointCloud.concatenate(list(clouds)), read_ply(truth / "gt.ply")
    inside = np.any([cluster.region().contains(reference.points) for cluster in clusters], axis=0)
    scores = compare_clouds(
        cloud,
        reference.select(inside),
        mesh=truth / "gt_mesh.ply",
        options=CompareOptions(thresholds_m=THRESHOLDS_M),
    ).scores
    cells = [
        clusters[0].name if len(clusters) == 1 else "all",
        kind.value,
        f"{sum(len(cluster.image_names) for cluster in clusters)}",
        f"{sum(num_selected)}",
        f"{sum(stereo_s):.0f}",
        f"{len(cloud):,}",
        *(f"{100 * s.accuracy:.1f} / {100 * s.completeness:.1f} / {100 * s.f_score:.1f}" for s in scores),
    ]
    print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
