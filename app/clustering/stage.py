"""The clustering stage: a posed model -> clusters, a report and a map."""

from __future__ import annotations

import json
import logging
from collections import Counter
from pathlib import Path
from typing import Any

from app.clustering.clusters import Clustering, cluster_views
from app.clustering.map_picture import write_map
from app.clustering.options import ClusteringOptions
from app.errors import InputError
from app.scene.posed_scene import PosedScene
from app.scene.read_model import read_posed_scene

logger = logging.getLogger(__name__)


def cluster(model_dir: Path, output_dir: Path, *, options: ClusteringOptions) -> Clustering:
    """Cut a model into clusters of views, [O] section 3.

    Args:
        model_dir: COLMAP model with z up.
        output_dir: Gets ``clusters.jsonl``, ``report.json`` and ``map.png``.
        options: Lengths in units of the model.

    Raises:
        InputError: the model can't be read, or no block has enough keypoints and an image near by.
    """
    scene = read_posed_scene(model_dir)
    clustering = cluster_views(scene, options)
    if not clustering.clusters:
        raise InputError(
            f"no block in {model_dir} has {options.min_keypoints_per_block} keypoints and an image that sees it from"
            f" {options.max_camera_distance_m:g} m away; check the model's scale and that z is up,"
            " or raise clustering.max_camera_distance_m"
        )
    report = _report(scene, clustering)
    _log(report)
    output_dir.mkdir(parents=True, exist_ok=True)
    write_map(scene, clustering, output_dir / "map.png")
    (output_dir / "report.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    clustering.write(output_dir)
    return clustering


def _report(scene: PosedScene, clustering: Clustering) -> dict[str, Any]:
    """The rows of [O]'s table 1 for clustering, and everything that is in no cluster or in a small one."""
    num_images, num_clusters = len(scene.image_names), len(clustering.clusters)
    num_associated = sum(len(cluster.image_names) for cluster in clustering.clusters)
    associated = {name for cluster in clustering.clusters for name in cluster.image_names}
    return {
        "num_images": num_images,
        "num_keypoints": len(scene.point_ids),
        "num_clusters": num_clusters,
        "num_images_after_clustering": num_associated,
        "clusters_per_image": num_associated / num_images,
        "images_per_cluster": num_associated / num_clusters,
        "num_far_keypoints": clustering.num_far_keypoints,
        "small_clusters": {c.name: len(c.image_names) for c in clustering.clusters if c.is_small},
        "images_in_no_cluster": [name for name in scene.image_names if name not in associated],
        "dropped_blocks": [
            {"cell": block.cell, "num_keypoints": block.num_keypoints, "reason": block.reason}
            for block in clustering.dropped
        ],
    }


def _log(report: dict[str, Any]) -> None:
    logger.info(
        "%d images in %d clusters: %.1f images per cluster, %.2f clusters per image",
        report["num_images"],
        report["num_clusters"],
        report["images_per_cluster"],
        report["clusters_per_image"],
    )
    for reason, count in sorted(Counter(block["reason"] for block in report["dropped_blocks"]).items()):
        logger.info("%d blocks dropped: %s", count, reason)
    if report["images_in_no_cluster"]:
        logger.info("%d images see no cluster and are not used", len(report["images_in_no_cluster"]))
    for name, count in report["small_clusters"].items():
        logger.warning("cluster %s has only %d images and no neighbour to merge with", name, count)
