"""Comparing clouds whose distances are known."""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from fusion.cloud import PointCloud
from fusion.compare import CompareOptions, cloud_distances, compare_clouds, format_table
from fusion.errors import CloudFormatError, FusionError

pytestmark = pytest.mark.usefixtures("open3d")

ALL_POINTS = CompareOptions(voxel_m=0.0, thresholds_m=(0.02, 0.05, 0.10))


def plane(n_x: int, n_y: int, z: float, spacing_m: float = 0.1) -> PointCloud:
    """A level grid of points."""
    x, y = np.meshgrid(np.arange(n_x) * spacing_m, np.arange(n_y) * spacing_m)
    return PointCloud(np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], axis=1).astype(np.float32))


def write_square(path: Path, size_m: float, z: float) -> None:
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
        f"-1 -1 {z}\n{size_m} -1 {z}\n{size_m} {size_m} {z}\n-1 {size_m} {z}\n3 0 1 2\n3 0 2 3\n"
    )


def test_a_raised_half_plane() -> None:
    """The cloud covers half of the reference, a quarter of it 3 cm and a quarter 7 cm above it.

    side view:   ....            7 cm
                     ....        3 cm
                 ________________ reference (0)
    """
    cloud = PointCloud.concatenate([plane(10, 5, 0.07), plane(10, 5, 0.03)])
    cloud.points[50:, 1] += np.float32(0.5)
    result = compare_clouds(cloud, plane(10, 20, 0.0), options=ALL_POINTS)
    assert [score.accuracy for score in result.scores] == [0.0, 0.5, 1.0]
    assert [score.completeness for score in result.scores] == [0.0, 0.25, 0.5]
    assert result.scores[1].f_score == pytest.approx(2 * 0.5 * 0.25 / 0.75)
    assert result.scores[0].f_score == 0.0
    assert result.cloud_to_reference.mean_m == pytest.approx(0.05, abs=1e-6)
    assert result.cloud_to_reference.rms_m == pytest.approx(np.sqrt((0.07**2 + 0.03**2) / 2), abs=1e-6)
    assert result.cloud_to_reference.max_m == pytest.approx(0.07, abs=1e-6)
    assert result.chamfer_m == pytest.approx((result.cloud_to_reference.mean_m + result.reference_to_cloud.mean_m) / 2)
    assert result.reference.spacing_m == pytest.approx(0.1, abs=1e-6)


def test_a_mesh_replaces_the_samples_for_accuracy_only(tmp_path: Path) -> None:
    mesh = tmp_path / "square.ply"
    write_square(mesh, 3.0, 0.0)
    cloud = plane(20, 20, 0.03)
    cloud.points[:, :2] += np.float32(0.05)
    result = compare_clouds(cloud, plane(20, 20, 0.0), mesh=mesh, options=ALL_POINTS)
    assert [score.accuracy for score in result.scores] == [0.0, 1.0, 1.0]
    assert [score.completeness for score in result.scores] == [0.0, 0.0, 1.0]
    assert result.cloud_to_mesh is not None
    assert result.cloud_to_mesh.max_m == pytest.approx(0.03, abs=1e-6)
    assert result.cloud_to_reference.median_m == pytest.approx(np.sqrt(0.03**2 + 2 * 0.05**2), abs=1e-6)


def test_dense_places_count_no_more_than_sparse_ones() -> None:
    good, bad = plane(10, 10, 0.01), plane(10, 10, 0.26)
    crowded = PointCloud.concatenate([good] * 50 + [bad])
    result = compare_clouds(crowded, plane(10, 10, 0.01), options=CompareOptions(thresholds_m=(0.1,)))
    assert result.cloud.n_points == 5100
    assert result.cloud.n_compared == 200
    assert result.scores[0].accuracy == 0.5


def test_only_points_inside_the_bounds_count() -> None:
    options = CompareOptions(voxel_m=0.0, thresholds_m=(0.05,), bounds_m=(-1, -1, -1, 0.45, 9, 1))
    result = compare_clouds(plane(5, 5, 0.0), plane(10, 5, 0.0), options=options)
    assert result.reference.n_compared == 25
    assert result.scores[0].completeness == 1.0
    with pytest.raises(FusionError, match="the cloud has no points inside the bounds"):
        compare_clouds(plane(5, 5, 3.0), plane(5, 5, 0.0), options=options)


def test_distances_agree_with_the_plain_way() -> None:
    rng = np.random.default_rng(3)
    a, b = rng.normal(size=(300, 3)).astype(np.float32), rng.normal(size=(200, 3)).astype(np.float32)
    plain = np.linalg.norm(a[:, None].astype(np.float64) - b[None], axis=2).min(axis=1)
    np.testing.assert_allclose(cloud_distances(a, b), plain, atol=1e-5)


def test_output_for_machines_and_people() -> None:
    result = compare_clouds(plane(10, 10, 0.03), plane(10, 10, 0.0), options=ALL_POINTS)
    parsed = json.loads(result.to_json())
    assert parsed["scores"][1]["threshold_m"] == 0.05
    assert parsed["scores"][1]["accuracy"] == 1.0
    table = format_table(result)
    assert "accuracy (to reference)" in table
    accuracy = next(line for line in table.splitlines() if line.startswith("accuracy"))
    assert accuracy.split()[-6:] == ["0.0", "%", "100.0", "%", "100.0", "%"]


def test_what_cannot_be_compared(tmp_path: Path) -> None:
    empty = PointCloud(np.empty((0, 3), dtype=np.float32))
    with pytest.raises(FusionError, match="the reference has no points"):
        compare_clouds(plane(3, 3, 0.0), empty)
    no_mesh = tmp_path / "points.ply"
    no_mesh.write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
        "end_header\n0 0 0\n"
    )
    with pytest.raises(CloudFormatError, match="no triangles"):
        compare_clouds(plane(3, 3, 0.0), plane(3, 3, 0.0), mesh=no_mesh)
    with pytest.raises(ValueError, match="thresholds_m"):
        CompareOptions(thresholds_m=())


def test_a_machine_without_open3d_libraries_is_told_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(name: str) -> ModuleType:
        raise OSError("libEGL.so.1: cannot open shared object file")

    monkeypatch.setattr(importlib, "import_module", fail)
    with pytest.raises(FusionError, match="libEGL.so.1.*apt install libegl1"):
        compare_clouds(plane(3, 3, 0.0), plane(3, 3, 0.0))
