"""Fusion of two views' maps of a wall: each option decides whether they agree."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from app.densify import fuse_job
from fusion.cloud import read_ply
from fusion.depth_fusion import FusionOptions, fuse_depth_maps
from fusion.errors import FusionError
from fusion.region import GroundRegion
from mvs_backends.base import MvsJob
from mvs_backends.colmap_maps import write_maps
from tests.reference.plane_scene import plane_job, true_depth, write_model

WIDTH, HEIGHT, DISTANCE = 64, 48, 5.0
EVERYWHERE = np.array([[-9.0, -9.0, 0.0], [9.0, 9.0, 9.0]])
OPTIONS = FusionOptions()


def wall(folder: Path, *, farther: float = 0.0, turned_deg: float = 0.0) -> MvsJob:
    """A dense workspace with the true maps of two views, but for the second one's errors.

       x   x      farther: the second one's depths, relatively
        \\ /       turned: its normals
    ==========
    """
    job = plane_job(folder, normal=(0.0, 0.0, 1.0), offset=DISTANCE, size=(WIDTH, HEIGHT), num_views=2)
    write_model(job)
    (folder / "stereo" / "fusion.cfg").write_text("".join(f"{view.name}\n" for view in job.views))
    for index, view in enumerate(job.views):
        angle = np.radians(index * turned_deg)
        towards = view.cam_from_world[:, :3] @ [np.sin(angle), 0.0, -np.cos(angle)]
        depth = true_depth(view, np.array([0.0, 0.0, 1.0]), DISTANCE) * (1 + index * farther)
        write_maps(job, index, depth.astype(np.float32), np.tile(towards, (HEIGHT, WIDTH, 1)).astype(np.float32))
    return job


def fused_points(job: MvsJob, bounds: NDArray[np.float64] = EVERYWHERE, **changed: float) -> NDArray[np.float32]:
    options = dataclasses.replace(OPTIONS, **changed)
    return fuse_depth_maps(job.workspace, job.workspace / "fused.ply", options=options, bounds=bounds).points


def test_views_that_agree_make_the_wall(tmp_path: Path) -> None:
    points = fused_points(wall(tmp_path))
    assert len(points) > 2500
    np.testing.assert_allclose(points[:, 2], DISTANCE, atol=5e-3)


@pytest.mark.parametrize(
    ("option", "agree", "differ", "errors"),
    [
        ("min_num_pixels", 2, 3, {}),
        # A wall's pixel lies up to half a pixel beside the nearest one of the other view.
        ("max_reproj_error_px", 1.0, 0.05, {}),
        ("max_depth_error", 0.005, 0.003, {"farther": 0.004}),
        ("max_depth_error", 0.007, 0.005, {"farther": 0.006}),
        ("max_normal_error_deg", 10.0, 8.0, {"turned_deg": 9.0}),
        ("max_normal_error_deg", 12.0, 10.0, {"turned_deg": 11.0}),
    ],
)
def test_each_option_decides_what_agrees(
    tmp_path: Path, option: str, agree: float, differ: float, errors: dict[str, float]
) -> None:
    job = wall(tmp_path, **errors)
    assert len(fused_points(job, **{option: agree})) > 2000
    assert len(fused_points(job, **{option: differ})) < 100


def test_only_points_within_the_bounds_are_fused(tmp_path: Path) -> None:
    bounds = np.array([[-0.5, -9.0, 0.0], [9.0, 0.25, 9.0]])
    points = fused_points(wall(tmp_path), bounds)
    assert len(points) > 200
    assert points[:, 0].min() > -0.55 and points[:, 0].max() > 1
    assert points[:, 1].max() < 0.3 and points[:, 1].min() < -1


def test_a_missing_map_is_named(tmp_path: Path) -> None:
    job = wall(tmp_path)
    job.depth_map_path(1).unlink()
    with pytest.raises(FusionError, match=r"depth_maps/cam/001\.png\.geometric\.bin is missing"):
        fused_points(job)


def test_a_workspace_without_model_is_named(tmp_path: Path) -> None:
    job = wall(tmp_path)
    shutil.rmtree(tmp_path / "sparse")
    with pytest.raises(FusionError, match=f"{tmp_path}: stereo fusion failed"):
        fused_points(job)


def test_the_stage_crops_and_thins_what_it_fuses_by_its_options(tmp_path: Path) -> None:
    region = GroundRegion(
        cells=((0, 0),), origin_m=(-0.5, -0.5), cell_size_m=(2.0, 1.0), z_range_m=(0.0, 9.0), padding_m=0.1
    )
    record = {"region": dataclasses.asdict(region), "cameras": {}, "images": []}
    (tmp_path / "job.json").write_text(json.dumps(record))
    wall(tmp_path / "dense")
    clouds = {}
    for name, changed in {"all": {}, "few": {"voxel_m": 0.2}, "none": {"max_reproj_error_px": 1e-3}}.items():
        options = dataclasses.replace(OPTIONS, **changed)
        fuse_job(tmp_path, tmp_path / "dense", tmp_path / name, options, lambda done, total: None)
        cloud = tmp_path / name / "cloud.ply"
        clouds[name] = read_ply(cloud).points if cloud.exists() else np.empty((0, 3))
        assert region.contains(clouds[name]).all()
    assert len(clouds["all"]) > 400
    assert 40 < len(clouds["few"]) == len(np.unique(np.floor(clouds["all"].astype(np.float64) / 0.2), axis=0))
    assert len(clouds["none"]) == 0
