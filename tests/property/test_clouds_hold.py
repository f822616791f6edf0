"""Invariants of point clouds: files keep every bit, thinning keeps one real point per voxel in any order."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from fusion.cloud import PointCloud, read_ply, write_ply
from fusion.thinning import thin


@st.composite
def clouds(draw: st.DrawFn) -> PointCloud:
    n_points = draw(st.integers(1, 40))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    scale = draw(st.sampled_from([0.05, 1.0, 1000.0]))
    points = (scale * rng.normal(size=(n_points, 3))).astype(np.float32)
    if draw(st.booleans()):
        points = np.round(points, 1)
    normals = rng.normal(size=(n_points, 3)).astype(np.float32) if draw(st.booleans()) else None
    colors = rng.integers(0, 256, (n_points, 3), dtype=np.uint8) if draw(st.booleans()) else None
    return PointCloud(points, normals, colors)


@settings(max_examples=40, derandomize=True, deadline=None)
@given(clouds())
def test_a_file_keeps_every_bit(cloud: PointCloud) -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "cloud.ply"
        write_ply(path, cloud)
        again = read_ply(path)
    for before, after in (
        (cloud.points, again.points),
        (cloud.normals, again.normals),
        (cloud.colors, again.colors),
    ):
        assert (before is None) == (after is None)
        if before is not None and after is not None:
            assert before.tobytes() == after.tobytes()


@settings(max_examples=60, derandomize=True, deadline=None)
@given(clouds(), st.sampled_from([0.03, 0.1, 1.0, 500.0]), st.integers(0, 1000))
def test_thinning_keeps_the_middle_point_of_each_voxel(cloud: PointCloud, voxel_m: float, seed: int) -> None:
    kept = thin(cloud, voxel_m)
    voxels: dict[tuple[int, ...], list[float]] = {}
    for point in cloud.points.astype(np.float64) / voxel_m:
        cell = np.floor(point)
        voxels.setdefault(tuple(cell.astype(int)), []).append(float(((point - cell - 0.5) ** 2).sum()))
    found = {}
    for point in kept.points.astype(np.float64) / voxel_m:
        cell = np.floor(point)
        found[tuple(cell.astype(int))] = float(((point - cell - 0.5) ** 2).sum())
    assert len(kept) == len(found)
    assert found == {cell: min(offsets) for cell, offsets in voxels.items()}
    assert {point.tobytes() for point in kept.points} <= {point.tobytes() for point in cloud.points}
    shuffled = thin(cloud.select(np.random.default_rng(seed).permutation(len(cloud))), voxel_m)
    np.testing.assert_array_equal(shuffled.points, kept.points)
