"""Clustering and selection that know what hides points, in the two streets of `tests.reference.two_streets`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from app.clustering.clusters import Cluster, cluster_views
from app.clustering.options import BlockVisibility, ClusteringOptions
from app.scene.posed_scene import PosedScene
from app.view_selection.options import SelectionOptions, Visibility
from app.view_selection.problem import ProblemCutter
from app.view_selection.selection import select_views
from app.view_selection.visibility import unpack_rows, visible_points
from tests.reference.two_streets import two_streets

OPTIONS = ClusteringOptions(block_size_m=(30.0, 12.0), overlap_m=0.0)
"""Two blocks, y from 0 to 12 and from 12 to 24: each has one street and the half of the houses beside it."""


@pytest.fixture(scope="module")
def scene() -> PosedScene:
    return two_streets()


def blocks(scene: PosedScene, visibility: BlockVisibility) -> tuple[Cluster, Cluster]:
    here, there = cluster_views(scene, replace(OPTIONS, visibility=visibility)).clusters
    return here, there


def streets(names: tuple[str, ...]) -> set[str]:
    return {name.split("/")[0] for name in names}


def test_only_images_that_see_a_block_past_the_houses_join_it(scene: PosedScene) -> None:
    by_frustum, by_sight = blocks(scene, BlockVisibility.FRUSTUM), blocks(scene, BlockVisibility.OCCLUDED)
    assert [streets(tuple(block.image_names)) for block in by_frustum] == [{"here", "there"}] * 2
    assert [streets(tuple(block.image_names)) for block in by_sight] == [{"here"}, {"there"}]
    assert [len(block.image_names) for block in by_sight] == [15, 15]


def test_clusters_do_not_depend_on_the_number_of_threads(scene: PosedScene) -> None:
    options = replace(OPTIONS, block_size_m=(3.0, 4.0), min_cameras_per_cluster=1, visibility=BlockVisibility.OCCLUDED)
    one, four = (cluster_views(scene, options, num_threads) for num_threads in (1, 4))
    assert one == four
    assert len({cluster.image_names for cluster in one.clusters}) > 10


def test_selection_takes_no_image_from_behind_the_houses(scene: PosedScene) -> None:
    here, _ = blocks(scene, BlockVisibility.FRUSTUM)
    options = SelectionOptions(visibility=Visibility.OCCLUDED, n_low=4)
    found = select_views(ProblemCutter(scene).problem(here, Visibility.OCCLUDED), options)
    assert streets(found.image_names) == {"here"}


def test_samples_inside_houses_ask_for_nothing(scene: PosedScene) -> None:
    here, _ = blocks(scene, BlockVisibility.FRUSTUM)
    problem = ProblemCutter(scene).problem(here, Visibility.OCCLUDED)
    visible = visible_points(problem, Visibility.OCCLUDED)
    _, y, z = problem.samples_in_world.T
    in_the_open = int(((y < 8) | (z > 8)).sum())
    num_samples = len(visible.by_point) - len(problem.keypoints_in_world)
    assert 200 < num_samples <= in_the_open < len(z)


def test_what_an_image_observes_it_sees(scene: PosedScene) -> None:
    for block in blocks(scene, BlockVisibility.FRUSTUM):
        cutter = ProblemCutter(scene)
        seen = visible_points(cutter.problem(block, Visibility.OCCLUDED), Visibility.OCCLUDED)
        tracked = cutter.problem(block, Visibility.TRACKS)
        in_image = visible_points(tracked, Visibility.FRUSTUM)
        num_views = len(block.image_names)
        points, views = tracked.observations.T
        assert len(points) > 1000
        both = [unpack_rows(bits.by_point, num_views)[points, views] for bits in (seen, in_image)]
        np.testing.assert_array_equal(*both)


def test_a_problem_for_another_visibility_is_refused(scene: PosedScene) -> None:
    here, _ = blocks(scene, BlockVisibility.FRUSTUM)
    with pytest.raises(ValueError, match="what hides its points"):
        visible_points(ProblemCutter(scene).problem(here, Visibility.FRUSTUM), Visibility.OCCLUDED)
