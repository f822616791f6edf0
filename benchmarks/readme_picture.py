"""Draw the README's picture: input images above, the cloud and its distance to the ground truth below.

python -m benchmarks.readme_picture WORKSPACE CLOUD.ply PICTURE.jpg
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

from app.scene.read_model import read_posed_scene
from benchmarks.alignment import fit_rigid
from fusion.cloud import PointCloud, read_ply
from fusion.compare import mesh_distances
from fusion.picture import PictureOptions, draw_errors, render_cloud

_STREET = Path(__file__).parents[1] / "sample_data" / "street"
_FRAMES = ("000000", "000007", "000014")
_CAMERAS = ("cam1", "cam0", "cam2")


def main() -> None:
    """Draw it."""
    workspace, cloud_file, picture = (Path(argument) for argument in sys.argv[1:])
    scene = read_posed_scene(workspace / "georegister" / "model")
    truth = {e["image"]: e["C"] for e in json.loads((_STREET / "poses_gt.json").read_text(encoding="utf-8"))}
    rotation, translation = fit_rigid(scene.centers_in_world, np.array([truth[name] for name in scene.image_names]))
    found = read_ply(cloud_file)
    cloud = PointCloud((found.points @ rotation.T + translation).astype(np.float32), None, found.colors)
    images = [
        [cv2.imread(str(_STREET / "images" / camera / f"{frame}.jpg")) for camera in _CAMERAS] for frame in _FRAMES
    ]
    strip = np.hstack([np.hstack(row) for row in images])
    options = PictureOptions(width_px=900, height_px=800)
    with tempfile.TemporaryDirectory() as scratch:
        errors = Path(scratch) / "errors.png"
        draw_errors(
            errors,
            cloud,
            mesh_distances(cloud.points, _STREET / "gt_mesh.ply"),
            title="distance to the true surface",
            options=options,
        )
        right = cv2.imread(str(errors))
    left = np.empty_like(right)
    left[:] = right[0, 0]
    left[right.shape[0] - options.height_px :] = render_cloud(cloud, options=options)
    below = np.hstack([left, right])
    above = cv2.resize(strip, (below.shape[1], round(strip.shape[0] * below.shape[1] / strip.shape[1])))
    picture.parent.mkdir(parents=True, exist_ok=True)
    # Single points are as small as a pixel: their colours need every one.
    sampling = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    cv2.imwrite(str(picture), np.vstack([above, below]), [cv2.IMWRITE_JPEG_QUALITY, 88, *sampling])


if __name__ == "__main__":
    main()
