"""The clustering stage: a posed model -> clusters, a report and a map."""

from __future__ import annotations

import json
import logging
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from app.clustering.association import Blocks
from app.clustering.clusters import SCENE_FOLDER, Clustering, cluster_name, find_blocks, name_clusters
from app.clustering.map_labels import MapLabels
from app.clustering.map_picture import write_map
from app.clustering.options import ClusteringOptions
from app.errors import InputError
from app.scene.posed_scene import PosedScene
from app.scene.read_model import open_scene, store_scene

logger = logging.getLogger(__name__)


def cluster(
    model_dir: Path,
    output_dir: Path,
    *,
    options: ClusteringOptions,
    labels: MapLabels | None = None,
    num_threads: int = 1,
) -> Clustering:
    """Cut a model into clusters of views, [O] section 3.

    Args:
        model_dir: COLMAP model with z up.
        output_dir: Gets ``clusters.jsonl``, ``report.json``, ``map.png``, and the model as ``scene/`` for later stages.
        options: Lengths in units of the model.
        labels: Of the map's axes; by default metres, and y to the north.
        num_threads: Of the search for what hides blocks from images; the result doesn't depend on it.

    Raises:
        InputError: the model can't be read, or no block has enough keypoints and an image near by.
    """
    store_scene(model_dir, output_dir / SCENE_FOLDER)
    scene = open_scene(output_dir / SCENE_FOLDER)
    blocks = find_blocks(scene, options, num_threads)
    if not blocks.kept:
        raise InputError(
            f"no block in {model_dir} has {options.min_keypoints_per_block} keypoints and an image that sees it from"
            f" {options.max_camera_distance_m:g} m away; check the model's scale and that z is up,"
            " or raise clustering.max_camera_distance_m"
        )
    clustering = name_clusters(scene, blocks, options)
    report = _report(scene, blocks, options)
    _log(report)
    write_map(scene, clustering, output_dir / "map.png", labels or MapLabels())
    (output_dir / "report.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    clustering.write(output_dir)
    return clustering


def _report(scene: PosedScene, blocks: Blocks, options: ClusteringOptions) -> dict[str, Any]:
    """The rows of [O]'s table 1 for clustering, and everything that is in no cluster or in a small one."""
    num_images, num_clusters = len(scene.image_names), len(blocks.kept)
    num_associated = sum(len(block.image_rows) for block in blocks.kept)
    in_no_cluster = np.ones(num_images, dtype=np.bool_)
    for block in blocks.kept:
        in_no_cluster[block.image_rows] = False
    return {
        "num_images": num_images,
        "num_keypoints": len(scene.point_ids),
        "num_clusters": num_clusters,
        "num_images_after_clustering": num_associated,
        "clusters_per_image": num_associated / num_images,
        "images_per_cluster": num_associated / num_clusters,
        "num_far_keypoints": blocks.num_far_keypoints,
        "small_clusters": {
            cluster_name(block): len(block.image_rows)
            for block in blocks.kept
            if len(block.image_rows) < options.min_cameras_per_cluster
        },
        "images_in_no_cluster": scene.image_names.take(np.flatnonzero(in_no_cluster)),
        "dropped_blocks": [
            {"cell": block.cell, "num_keypoints": block.num_keypoints, "reason": block.reason}
            for block in blocks.dropped
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
        logger.info("%d %s dropped: %s", count, "block" if count == 1 else "blocks", reason)
    if report["images_in_no_cluster"]:
        logger.info("%d images see no cluster and are not used", len(report["images_in_no_cluster"]))
    for name, count in report["small_clusters"].items():
        logger.warning("cluster %s has only %d images and no neighbour to merge with", name, count)
