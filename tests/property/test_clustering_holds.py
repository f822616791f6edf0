"""What must hold for the clusters of any scene."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from app.clustering.association import Block, DropReason
from app.clustering.clusters import cluster_views
from app.clustering.merging import merge_small_blocks
from app.clustering.options import ClusteringOptions
from app.clustering.samples import grid_points, sample_axes
from fusion.region import GroundRegion
from tests.reference import visibility as plain
from tests.reference.posed_scenes import random_scene, shuffled

few = settings(max_examples=15, derandomize=True, deadline=None)
many = settings(max_examples=60, derandomize=True, deadline=None)
seeds = st.integers(0, 10_000)


@st.composite
def options(draw: st.DrawFn) -> ClusteringOptions:
    return ClusteringOptions(
        block_size_m=(draw(st.sampled_from([5.0, 20.0, 33.3])), draw(st.sampled_from([7.0, 20.0]))),
        overlap_m=draw(st.sampled_from([0.0, 2.0])),
        sample_spacing_m=draw(st.sampled_from([1.0, 3.0])),
        min_keypoints_per_block=draw(st.integers(1, 8)),
        max_camera_distance_m=draw(st.sampled_from([10.0, 40.0])),
        min_cameras_per_cluster=draw(st.integers(1, 12)),
    )


@few
@given(seeds, options())
def test_every_cell_with_enough_keypoints_is_in_exactly_one_cluster_or_has_no_image(
    seed: int, options: ClusteringOptions
) -> None:
    scene = random_scene(seed)
    clustering = cluster_views(scene, options)
    keypoints = Counter(
        tuple(math.floor((p[k] - clustering.grid.origin_m[k]) / options.block_size_m[k]) for k in range(2))
        for p in scene.points_in_world
    )
    clustered = [cell for found in clustering.clusters for cell in found.cells]
    assert len(set(clustered)) == len(clustered)
    dropped = {block.cell: block for block in clustering.dropped}
    assert not set(clustered) & set(dropped)
    num_far = 0
    for cell, count in keypoints.items():
        if cell in clustered:
            assert count >= options.min_keypoints_per_block
        elif cell in dropped:
            assert dropped[cell].num_keypoints == count
            assert count < options.min_keypoints_per_block or dropped[cell].reason is DropReason.NO_IMAGE
        else:
            num_far += count
            cameras = scene.centers_in_world[:, :2]
            center = clustering.grid.origin_m + (np.array(cell) + 0.5) * options.block_size_m
            assert np.hypot(*(cameras - center).T).min() > options.max_camera_distance_m
    assert num_far == clustering.num_far_keypoints
    assert sum(c.num_keypoints for c in clustering.clusters) == sum(keypoints[cell] for cell in clustered)


@few
@given(seeds, options())
def test_the_images_of_a_cluster_are_those_near_a_cell_that_see_a_point_of_it(
    seed: int, options: ClusteringOptions
) -> None:
    scene = random_scene(seed, num_images=30)
    clustering = cluster_views(scene, replace(options, min_cameras_per_cluster=1))
    size = np.array(options.block_size_m)
    for found in clustering.clusters[:6]:
        (cell,) = found.cells
        box = found.region().padded_boxes()[0]
        box[:, 2] = found.z_range_m
        points = scene.points_in_world
        inside = np.all((points[:, :2] >= box[0, :2]) & (points[:, :2] <= box[1, :2]), axis=1)
        points = np.concatenate([points[inside], grid_points(sample_axes(box, options.sample_spacing_m))])
        center = clustering.grid.origin_m + (np.array(cell) + 0.5) * size
        near = np.hypot(*(scene.centers_in_world[:, :2] - center).T) <= options.max_camera_distance_m
        sees = plain.cameras_with_a_view(points, scene.image_from_world, scene.image_sizes_px)
        expected = tuple(np.array(scene.image_names)[near & np.array(sees)].tolist())
        assert found.image_names == expected


@few
@given(seeds, options(), seeds)
def test_the_order_of_points_and_images_does_not_matter(seed: int, options: ClusteringOptions, order: int) -> None:
    scene = random_scene(seed)
    other, _ = shuffled(scene, order)
    assert cluster_views(scene, options) == cluster_views(other, options)


@many
@given(
    st.dictionaries(
        st.tuples(st.integers(-4, 4), st.integers(-4, 4)),
        st.frozensets(st.integers(0, 15), min_size=1, max_size=8),
        max_size=25,
    ),
    st.integers(1, 12),
    st.randoms(use_true_random=False),
)
def test_merging_keeps_all_cells_and_stops_only_without_neighbours(
    images: dict[tuple[int, int], frozenset[int]], min_cameras: int, random: object
) -> None:
    blocks = [
        Block(cells=(cell,), num_keypoints=1, z_range_m=(0.0, 1.0), image_rows=np.array(sorted(rows)))
        for cell, rows in images.items()
    ]
    merged = merge_small_blocks(blocks, min_cameras)
    assert sorted(cell for block in merged for cell in block.cells) == sorted(images)
    for block in merged:
        assert block.num_keypoints == len(block.cells)
        assert set(block.image_rows.tolist()) == set().union(*(images[cell] for cell in block.cells))
        around = {(i + di, j + dj) for i, j in block.cells for di in (-1, 0, 1) for dj in (-1, 0, 1)}
        if len(block.image_rows) < min_cameras:
            assert not (around & set(images)) - set(block.cells)
        elif len(block.cells) == 1:
            assert len(images[block.cells[0]]) >= min_cameras
    random.shuffle(blocks)  # type: ignore[attr-defined]
    again = merge_small_blocks(blocks, min_cameras)
    assert [block.cells for block in again] == [block.cells for block in merged]


@many
@given(
    seeds,
    st.floats(-1e6, 1e6),
    st.floats(-1e6, 1e6),
    st.floats(0.01, 100),
    st.floats(0.01, 100),
    st.sampled_from([np.float32, np.float64]),
)
def test_regions_tile_the_plane(
    seed: int, origin_x: float, origin_y: float, size_x: float, size_y: float, dtype: type[np.floating]
) -> None:
    rng = np.random.default_rng(seed)
    origin, size = np.array([origin_x, origin_y]), np.array([size_x, size_y])
    points = np.column_stack([origin + rng.uniform(-2, 2, (100, 2)) * size, rng.normal(0, 1e3, 100)])
    points[:30, :2] = origin + rng.integers(-2, 3, (30, 2)) * size
    points = points.astype(dtype)
    cells = sorted(
        {tuple(cell) for cell in np.floor((points[:, :2].astype(float) - origin) / size).astype(int).tolist()}
    )
    owners = np.zeros(len(points), dtype=int)
    for part in (cells[::3], cells[1::3], cells[2::3]):
        if part:
            region = GroundRegion(
                cells=tuple(part),
                origin_m=(origin_x, origin_y),
                cell_size_m=(size_x, size_y),
                z_range_m=(0, 1),
                padding_m=1,
            )
            owners += region.contains(points)
            boxes = region.padded_boxes()
            inside = points[region.contains(points), :2].astype(float)
            slack = 1e-6 * (1 + np.abs(origin).max())
            covered = (inside[:, None] >= boxes[:, 0, :2] - slack) & (inside[:, None] <= boxes[:, 1, :2] + slack)
            assert covered.all(axis=2).any(axis=1).all()
    assert (owners == 1).all()


def test_no_region_contains_what_is_nowhere() -> None:
    region = GroundRegion(
        cells=((0, 0),), origin_m=(0.0, 0.0), cell_size_m=(1.0, 1.0), z_range_m=(0.0, 1.0), padding_m=0.5
    )
    points = np.array([[np.nan, 0.5, 0], [np.inf, 0.5, 0], [1e300, 0.5, 0], [0.5, 0.5, np.nan], [1.0, 0.5, 0]])
    assert region.contains(points).tolist() == [False, False, False, True, False]
