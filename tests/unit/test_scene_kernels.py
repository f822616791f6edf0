"""Each kernel against its plain twin on random input."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from app.clustering.kernels import cameras_with_a_view
from app.clustering.samples import grid_points
from app.scene.kernels import gather_bytes, gather_track_image_ids, index_images, index_points, sees
from app.scene.submodel import write_submodel
from app.view_selection.kernels import frustum_bits, share_at_least, transpose_bits, undominated
from app.view_selection.visibility import pack_rows, unpack_rows
from tests.reference import visibility as plain
from tests.reference.posed_scenes import random_scene


def test_sees_is_the_projection_into_the_image() -> None:
    scene = random_scene(1)
    matrices, sizes = scene.image_from_world, scene.image_sizes_px
    expected = plain.visibility_matrix(scene.points_in_world, matrices, sizes)
    found = [[sees(m, s, p) for m, s in zip(matrices, sizes, strict=True)] for p in scene.points_in_world]
    assert 0.02 < expected.mean() < 0.98
    np.testing.assert_array_equal(found, expected)
    bits = frustum_bits(scene.points_in_world, matrices, sizes)
    np.testing.assert_array_equal(unpack_rows(bits, len(matrices)), expected)


@pytest.mark.parametrize("seed", range(5))
def test_cameras_with_a_view(seed: int) -> None:
    scene = random_scene(seed, num_images=40)
    rng = np.random.default_rng(seed)
    corner = rng.uniform(-30, 30, 3)
    axes = tuple(corner[k] + np.sort(rng.uniform(0, 6, 4)) for k in range(3))
    keypoints = rng.uniform(-20, 20, (2, 3))
    found = cameras_with_a_view(keypoints, *axes, scene.image_from_world, scene.image_sizes_px)
    points = np.concatenate([keypoints, grid_points(axes)])
    expected = plain.cameras_with_a_view(points, scene.image_from_world, scene.image_sizes_px)
    assert 0 < sum(expected) < 40
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("num_columns", [1, 63, 64, 65, 150])
def test_packed_sets(num_columns: int) -> None:
    rng = np.random.default_rng(num_columns)
    matrix = rng.random((90, num_columns)) < 0.2
    bits = pack_rows(matrix)
    np.testing.assert_array_equal(unpack_rows(bits, num_columns), matrix)
    np.testing.assert_array_equal(unpack_rows(transpose_bits(bits, num_columns), 90), matrix.T)
    sets = [set(np.flatnonzero(row).tolist()) for row in matrix]
    np.testing.assert_array_equal(share_at_least(bits, 3), plain.share_at_least(sets, 3))


@pytest.mark.parametrize("seed", range(5))
def test_undominated(seed: int) -> None:
    rng = np.random.default_rng(seed)
    matrix = rng.random((60, 70)) < rng.uniform(0.02, 0.3, (60, 1))
    bounds = rng.integers(1, 4, 60)
    order = np.lexsort((-bounds, matrix.sum(axis=1)))
    matrix, bounds = matrix[order], bounds[order]
    sets = [set(np.flatnonzero(row).tolist()) for row in matrix]
    expected = plain.undominated(sets, bounds.tolist())
    assert 0 < sum(expected) < 60
    np.testing.assert_array_equal(undominated(pack_rows(matrix), bounds), expected)


def test_records_of_a_binary_model(tmp_path: Path) -> None:
    scene = random_scene(2)
    write_submodel(scene, np.arange(20), np.arange(150), tmp_path)
    content = (tmp_path / "images.bin").read_bytes()
    data = np.frombuffer(content, dtype=np.uint8)
    index = index_images(data, int.from_bytes(content[:8], "little"))
    ids = gather_bytes(data, index[:-1, 0], 4).view("<u4")[:, 0]
    names = [content[start + 64 : end].decode() for start, end in index[:-1]]
    assert list(zip(ids.tolist(), names, strict=True)) == plain.image_records(content)
    assert index[-1, 0] == len(content)

    content = (tmp_path / "points3D.bin").read_bytes()
    data = np.frombuffer(content, dtype=np.uint8)
    points = index_points(data, int.from_bytes(content[:8], "little"))
    records = plain.point_records(content)
    offsets = np.concatenate([[0], np.cumsum([len(track) for _, track in records])])
    assert gather_bytes(data, points[:-1], 8).view("<u8")[:, 0].tolist() == [point_id for point_id, _ in records]
    assert gather_track_image_ids(data, points, offsets).tolist() == [i for _, track in records for i in track]
    for cut in range(8, len(content), 997):
        assert len(index_points(data[:cut], len(records))) == 0
