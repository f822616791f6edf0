"""What hides a place from a camera: a row of houses between two streets.

    y
20  |  . . . . . . . . . .      other street
16  |  ====================     facade of the other street, seen from y = 20
    |  ####################     houses, 8 m high
 8  |  ====================     facade of this street, seen from y = 4 (and from y = 0)
 4  |  . . . . . . . . . .      this street
 0  |___________________________ x, from 0 to 30
"""

from __future__ import annotations

import numpy as np
import pytest

from app.occlusion.kernels import clear_hidden, lower_to_rays, see_any
from app.occlusion.solid_columns import SolidColumns, solid_columns
from tests.reference import occlusion as plain
from tests.reference.two_streets import OTHER_STREET, STREET, cameras, facade

BOUNDS_M = np.array([[0.0, 0.0], [30.0, 24.0]])


def observed(
    walls: list[tuple[np.ndarray, np.ndarray]], radius_m: float = 15.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, and rays from each camera to all points of its wall within the radius: row of the point, and centre."""
    points = np.concatenate([wall for wall, _ in walls])
    rows, centers, first = [], [], 0
    for wall, views in walls:
        for view in views:
            near = np.flatnonzero(np.linalg.norm(wall - view, axis=1) < radius_m)
            rows.append(first + near)
            centers.append(np.tile(view, (len(near), 1)))
        first += len(wall)
    return points, np.concatenate(rows), np.concatenate(centers)


def solid_of(points: np.ndarray, rows: np.ndarray, centers: np.ndarray) -> SolidColumns:
    """What is solid in the rectangle, by rays with a centre each."""
    rays = np.arange(len(rows))
    return solid_columns(points, centers, ray_points=rows, ray_centers=rays, bounds_m=BOUNDS_M, column_m=1.0)


def is_seen(solid: SolidColumns, camera: list[float], point: list[float]) -> bool:
    left = solid.remove_hidden(np.ones((1, 1), np.uint64), np.array([camera]), np.array([point]))
    return bool(left[0, 0])


@pytest.fixture(scope="module")
def houses() -> SolidColumns:
    walls = [(facade(8.0), cameras(STREET)), (facade(16.0), cameras(OTHER_STREET))]
    return solid_of(*observed(walls))


def test_a_row_of_houses_hides_the_other_street(houses: SolidColumns) -> None:
    for x in (5.0, 15.0, 25.0):
        assert not is_seen(houses, [x, STREET, 1.7], [x + 2, OTHER_STREET, 1.0])
        assert not is_seen(houses, [x, STREET, 1.7], [x, 16.0, 4.0])
        assert not is_seen(houses, [x, OTHER_STREET, 1.7], [x - 1, 8.0, 3.0])


def test_the_open_street_and_its_facade_are_seen(houses: SolidColumns) -> None:
    for point in ([28.0, STREET, 0.1], [20.0, 8.0, 7.9], [29.0, 8.0, 1.0], [10.0, 1.0, 0.5], [15.0, 6.0, 7.5]):
        assert is_seen(houses, [2.0, STREET, 1.7], point)


def test_a_keypoint_a_little_behind_its_facade_is_seen(houses: SolidColumns) -> None:
    assert is_seen(houses, [10.0, STREET, 1.7], [11.0, 8.9, 3.0])


def test_nothing_inside_a_house_is_seen(houses: SolidColumns) -> None:
    for y, camera_y in ((11.0, STREET), (12.0, STREET), (12.0, OTHER_STREET)):
        assert not is_seen(houses, [14.0, camera_y, 1.7], [15.0, y, 3.0])


def test_what_rises_above_the_roofs_is_seen_over_them(houses: SolidColumns) -> None:
    assert is_seen(houses, [15.0, STREET, 1.7], [15.0, 16.0, 30.0])


def test_a_plain_wall_closes_between_its_windows() -> None:
    """Keypoints only around windows 3 m apart, as on a wall without texture; no ray passes between them."""
    wall = facade(8.0)
    wall = wall[(wall[:, 0] % 3.0 < 0.9) & (wall[:, 2] > 1.0)]
    solid = solid_of(*observed([(wall, cameras(STREET))]))
    hidden = [not is_seen(solid, [x, STREET, 1.7], [x, 15.0, 2.0]) for x in np.arange(3.0, 27.0, 0.5)]
    assert all(hidden)


def test_points_with_an_error_open_nothing_behind_their_wall() -> None:
    """The wall is at y = 7.9, its points up to 0.3 m behind it, many of them in the next column."""
    wall = facade(7.9)
    wall[:, 1] += np.random.default_rng(1).uniform(0, 0.3, len(wall))
    from_the_front = observed([(wall, cameras(STREET))], radius_m=4.8)
    solid = solid_of(*from_the_front)
    assert solid.hold(np.array([[x, 8.5, 1.0] for x in np.arange(3.5, 27.0)])).all()


def test_a_road_without_keypoints_is_free_below_the_rays() -> None:
    wall = facade(8.0)
    solid = solid_of(*observed([(wall[wall[:, 2] > 2], cameras(STREET))]))
    assert is_seen(solid, [2.0, STREET, 1.7], [20.0, 7.5, 1.0])


def test_a_gap_between_houses_that_is_looked_through_is_open() -> None:
    """Points far behind the gap at 14 < x < 16 are observed through it."""
    front = facade(8.0)
    front = front[(front[:, 0] < 14) | (front[:, 0] > 16)]
    behind = np.array([[15.0, 22.0, 0.5], [15.2, 22.0, 4.0]])
    camera = np.array([[15.0, STREET, 1.7]])
    points, rows, centers = observed([(front, cameras(STREET)), (behind, np.empty((0, 3)))])
    without = solid_of(points, rows, centers)
    rows = np.append(rows, [len(front), len(front) + 1])
    centers = np.concatenate([centers, camera, camera])
    through = solid_of(points, rows, centers)
    assert not is_seen(without, [15.0, STREET, 1.7], [15.0, 18.0, 1.5])
    assert is_seen(through, [15.0, STREET, 1.7], [15.0, 18.0, 1.5])
    assert not is_seen(through, [10.0, STREET, 1.7], [10.0, 18.0, 1.5])


def test_nothing_hides_where_there_are_no_points_near_by() -> None:
    solid = solid_of(np.array([[2.0, 2.0, 9.0]]), np.array([0]), np.array([[1.0, 1.0, 1.7]]))
    assert is_seen(solid, [29.0, 1.0, 1.7], [29.0, 23.0, 1.7])


def test_cameras_and_points_outside_the_rectangle_are_seen_past_it(houses: SolidColumns) -> None:
    assert is_seen(houses, [-50.0, 12.0, 1.7], [-40.0, 12.0, 1.7])
    assert not is_seen(houses, [15.0, -1e9, 1.7], [15.0, 1e9, 1.7])


def test_the_walks_agree_with_their_plain_twins() -> None:
    rng = np.random.default_rng(4)
    starts, ends = rng.uniform(-3, 12, (40, 3)), rng.uniform(-3, 12, (40, 3))
    ends[:5, 0], ends[5:10, 1] = starts[:5, 0], starts[5:10, 1]
    ends[10] = starts[10] + (0, 0, 3)
    heights = rng.uniform(0, 30, (9, 7))
    lowered = heights.copy()
    corner_m, column_m, gap_m = np.array([-2.0, 5.0]), 0.5, 0.7
    scale, shift = [column_m, column_m, 1.0], [*corner_m, 0.0]
    rays = np.arange(40)
    lower_to_rays(lowered, starts * scale + shift, ends * scale + shift, rays, rays, corner_m, column_m, gap_m)
    lengths_m = np.linalg.norm((ends - starts) * scale, axis=1, keepdims=True)
    cut = starts + np.maximum(1 - gap_m / lengths_m, 0) * (ends - starts)
    np.testing.assert_allclose(lowered, plain.lower_to_rays(heights, starts, cut), rtol=0, atol=1e-9)
    assert (lowered < heights).sum() > 20

    tops = rng.uniform(-2, 12, (9, 7))
    solid = np.array([[plain.solid_length(tops, start, end) for end in ends] for start in starts])
    seen = np.full((40, 1), (1 << 40) - 1, np.uint64)
    np.testing.assert_array_equal(see_any(seen, tops, starts, ends, 2.5), (solid <= 2.5).any(axis=1))
    few = seen & np.uint64(0b1011)
    np.testing.assert_array_equal(see_any(few, tops, starts, ends, 2.5), (solid <= 2.5)[:, [0, 1, 3]].any(axis=1))
    clear_hidden(seen, tops, starts, ends, 2.5)
    bits = (seen >> np.arange(40, dtype=np.uint64)) & np.uint64(1)
    np.testing.assert_array_equal(bits.astype(bool), solid <= 2.5)
    assert 200 < bits.sum() < 1400


def test_bits_that_do_not_fit_are_refused(houses: SolidColumns) -> None:
    with pytest.raises(ValueError, match="2 cameras and 3 points"):
        houses.remove_hidden(np.ones((3, 1), np.uint64), np.zeros((2, 3)), np.zeros((3, 3)))
    with pytest.raises(ValueError, match="2 cameras and 3 points"):
        houses.leave_any(np.ones((3, 1), np.uint64), np.zeros((2, 3)), np.zeros((3, 3)))
