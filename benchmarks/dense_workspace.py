"""The dense workspace of part of a posed model, as one cluster."""

from __future__ import annotations

import shutil
from collections.abc import Container
from pathlib import Path

import numpy as np
import pycolmap

from app.dense_job import prepare_workspace, write_dense_job
from app.options import DensifyOptions
from app.scene.point_index import PointIndex
from app.scene.read_model import read_posed_scene
from fusion.region import GroundRegion
from mvs_backends.base import MvsJob


def make_workspace(
    folder: Path, *, model: Path, images: Path, frames: Container[int], side_m: float = 0.0, max_image_size_px: int = 0
) -> MvsJob:
    """Prepare ``folder/workspace``, anew if there is one.

    Args:
        folder: to work in.
        model: COLMAP model, in metres, z up.
        images: what its image names are relative to.
        frames: image file names, as numbers, that take part.
        side_m: side of the square around the cameras that is reconstructed; 0: where the sparse points are.
        max_image_size_px: longer side of the images; 0: as they are.
    """
    scene = read_posed_scene(model)
    rows = [i for i, name in enumerate(scene.image_names) if int(Path(name).stem) in frames]
    low, high = np.percentile(scene.points_in_world, [0.5, 99.5], axis=0)
    corner, size = low[:2], high[:2] - low[:2]
    if side_m:
        corner, size = scene.centers_in_world[rows].mean(axis=0)[:2] - side_m / 2, np.full(2, side_m)
    region = GroundRegion(
        cells=((0, 0),),
        origin_m=(float(corner[0]), float(corner[1])),
        cell_size_m=(float(size[0]), float(size[1])),
        z_range_m=(float(low[2]), float(high[2])),
        padding_m=2.0,
    )
    reconstruction = pycolmap.Reconstruction(str(model))
    cameras = [reconstruction.cameras[camera_id] for camera_id in sorted(reconstruction.cameras)]
    job = folder / f"job{side_m:g}"
    write_dense_job(
        job,
        scene=scene,
        points=PointIndex(scene.points_in_world),
        image_rows=np.array(rows),
        region=region,
        cameras=cameras,
        digests={},
    )
    options = DensifyOptions(max_image_size_px=max_image_size_px)
    # What lies there may be of another size.
    shutil.rmtree(folder / "workspace", ignore_errors=True)
    return prepare_workspace(job, folder / "workspace", image_root=images, mask_root=None, options=options)
