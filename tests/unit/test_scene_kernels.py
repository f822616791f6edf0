"""Each kernel against its plain twin on random input."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from app.clustering.kernels import cameras_with_a_view
from app.clustering.samples import grid_points
from app.scene.kernels import (
    decode_tracks,
    frustum_bits,
    gather_bytes,
    gather_names,
    gather_tracks,
    index_images,
    index_points,
    sees,
)
from app.scene.submodel import write_submodel
from app.view_selection.kernels import (
    count_distinct,
    resolution_on_surface,
    share_at_least,
    transpose_bits,
    undominated,
)
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
    bits = frustum_bits(np.ascontiguousarray(scene.points_in_world.T), matrices, sizes)
    np.testing.assert_array_equal(unpack_rows(bits, len(scene.points_in_world)), expected.T)


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


def test_distinct_rows_in_the_order_of_their_first() -> None:
    rows = pack_rows(np.random.default_rng(0).random((500, 70)) < 0.02)
    first, counts = count_distinct(rows)
    expected, expected_first, expected_counts = np.unique(rows, axis=0, return_index=True, return_counts=True)
    assert 20 < len(expected) < 500
    order = np.argsort(expected_first)
    assert first.tolist() == expected_first[order].tolist()
    assert counts.tolist() == expected_counts[order].tolist()


def test_resolution_on_surface() -> None:
    rng = np.random.default_rng(3)
    points, centers, focal = rng.normal(0, 5, (40, 3)), rng.normal(0, 20, (70, 3)), rng.uniform(300, 900, 70)
    normals = rng.normal(0, 1, (40, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals[7] = 0
    seen = rng.random((40, 70)) < 0.3
    expected, distances = plain.resolution_on_surface(seen, points, normals, centers, focal)
    total, found_distances = resolution_on_surface(pack_rows(seen), points, normals, centers, focal)
    np.testing.assert_allclose(total, expected)
    np.testing.assert_allclose(np.sort(found_distances), np.sort(distances))


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
    data = np.frombuffer(content[8:], dtype=np.uint8)
    index = index_images(data, 1000)
    ids = gather_bytes(data, index[:-1, 0], 4).view("<u4")[:, 0]
    name_bytes = gather_names(data, index[:-1, 0] + 64, index[:-1, 1])
    names = [name.tobytes().rstrip(b"\0").decode() for name in name_bytes]
    assert list(zip(ids.tolist(), names, strict=True)) == plain.image_records(content)
    assert index[-1].tolist() == [len(data)] * 2
    assert index_images(data, 3).tolist() == index[:4].tolist()[:3] + [[index[3, 0]] * 2]
    for cut in range(0, len(data), 997):
        some = index_images(data[:cut], 1000)
        assert some[:-1].tolist() == index[: len(some) - 1].tolist()
        assert some[-1, 0] == index[len(some) - 1, 0]


def test_points_of_a_binary_model(tmp_path: Path) -> None:
    scene = random_scene(2)
    write_submodel(scene, np.arange(20), np.arange(150), tmp_path)
    content = (tmp_path / "points3D.bin").read_bytes()
    data = np.frombuffer(content[8:], dtype=np.uint8)
    index = index_points(data, 1000)
    records = plain.point_records(content)
    assert gather_bytes(data, index[:-1], 8).view("<u8")[:, 0].tolist() == [point_id for point_id, _ in records]
    positions = np.ascontiguousarray(gather_bytes(data, index[:-1] + 8, 24)).view("<f8")
    centers, ids = scene.centers_in_world[:18], scene.image_ids[:18]
    tracks = [sorted({image_id - 1 for image_id in track} & set(range(18))) for _, track in records]
    for table_length in (0, 7, 19):
        table = np.full(table_length, -1, dtype=np.int32)
        table[1:] = np.arange(max(0, table_length - 1))
        offsets, images, normals = decode_tracks(
            data, index, positions, centers, table, ids, np.arange(18, dtype=np.int32)
        )
        found = [images[start:end].tolist() for start, end in zip(offsets[:-1], offsets[1:], strict=True)]
        assert found == tracks
        np.testing.assert_allclose(normals, plain.mean_directions(positions, tracks, centers), atol=1e-6)
    chosen = np.array([3, 0, 7, 7])
    assert gather_tracks(offsets, images, chosen).tolist() == [image for point in chosen for image in tracks[point]]
    for cut in range(0, len(data), 997):
        some = index_points(data[:cut], 1000)
        assert some.tolist() == index[: len(some)].tolist()
