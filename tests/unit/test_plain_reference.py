"""The plain reference of [O] and the program find the same clusters, and equally small selections, on a short drive."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from app.clustering.clusters import find_blocks, name_clusters
from app.clustering.options import ClusteringOptions
from app.scene.read_model import open_scene, store_scene
from app.view_selection.options import SelectionMethod, SelectionOptions
from app.view_selection.problem import ProblemCutter
from app.view_selection.selection import select_views
from benchmarks.drives.presets import PRESETS
from benchmarks.drives.write_drive import write_drive
from benchmarks.reference.clustering import plain_clusters
from benchmarks.reference.quality import plain_quality
from benchmarks.reference.selection import best_quality, meets_all, plain_program, solve


def test_the_reference_agrees_with_the_program(tmp_path: Path) -> None:
    write_drive(replace(PRESETS["small"], num_keyframes=30, num_points=2_000), tmp_path / "model")
    store_scene(tmp_path / "model", tmp_path / "scene")
    scene = open_scene(tmp_path / "scene")
    # Coarse samples, for speed; small blocks, so that some must merge.
    options = ClusteringOptions(
        sample_spacing_m=3.0, block_size_m=(15.0, 15.0), max_camera_distance_m=20.0, min_cameras_per_cluster=60
    )
    blocks = find_blocks(scene, options)
    plain = plain_clusters(scene, options)

    shift = [round(origin / 15.0) for origin in blocks.grid.origin_m]
    cells = [tuple((i + shift[0], j + shift[1]) for i, j in block.cells) for block in blocks.kept]
    assert cells == [cluster.cells for cluster in plain]
    assert [set(block.image_rows.tolist()) for block in blocks.kept] == [set(cluster.images) for cluster in plain]
    assert [block.z_range_m for block in blocks.kept] == [pytest.approx(cluster.z_range) for cluster in plain]
    assert max(len(cluster.cells) for cluster in plain) > 1

    cutter, clusters = ProblemCutter(scene), name_clusters(scene, blocks, options).clusters
    for number in range(0, len(plain), 3):
        for method in SelectionMethod:
            selection = SelectionOptions(method=method, n_low=4, n_high=8, n_vis=3, min_shared_points=60)
            program = plain_program(scene, plain[number], options, selection)
            found = select_views(cutter.problem(clusters[number], selection.visibility), selection)
            rows = frozenset(scene.image_names.rows_of(found.image_names).tolist())
            smallest = solve(program, force_best_views=method is SelectionMethod.PAPER)
            assert meets_all(program, rows) and meets_all(program, smallest)
            assert len(rows) == len(smallest)
            if method is SelectionMethod.OPTIMAL and rows:
                quality, viewpoint = plain_quality(scene, program)
                best = best_quality(program, quality, viewpoint, len(rows))
                assert found.quality == pytest.approx(best, rel=1e-6)
