"""Pictures of clouds: points land where they should, and hide what is behind them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from fusion.cloud import PointCloud
from fusion.errors import FusionError
from fusion.picture import (
    PictureOptions,
    Projection,
    View,
    draw_errors,
    draw_side_by_side,
    error_colors,
    fit_projection,
    render_cloud,
    splat,
)

OPTIONS = PictureOptions(width_px=200, height_px=100, shading=False)


def square(z: float, color: tuple[int, int, int], n: int = 41) -> PointCloud:
    """A level square of 4 m around the origin."""
    x, y = np.meshgrid(np.linspace(-2, 2, n), np.linspace(-2, 2, n))
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], axis=1).astype(np.float32)
    return PointCloud(points, None, np.tile(np.array(color, dtype=np.uint8), (len(points), 1)))


def test_a_point_lands_at_its_pixel() -> None:
    """Seen from above, 10 pixels a metre, the origin in the middle of 200 x 100 pixels."""
    top = Projection(
        np.array([[1.0, 0, 0], [0, -1.0, 0], [0, 0, -1.0]]), np.array([0, 0, 9.0]), 10.0, False, (100.0, 50.0)
    )
    points = np.array([[3.05, 2.05, 0.0], [-10.0, 4.99, 0.0], [30.0, 0.0, 0.0]], dtype=np.float32)
    index, depth = splat(top, points, (100, 200), 0.01)
    assert index[29, 130] == 0
    assert index[0, 0] == 1
    assert depth[29, 130] == pytest.approx(9.0)
    assert (index >= 0).sum() == 2


def test_perspective_shrinks_with_depth() -> None:
    ahead = Projection(np.eye(3), np.zeros(3), 100.0, True, (50.0, 50.0))
    points = np.array([[1.0, 0, 4.0], [1.0, 0, 10.0], [1.0, 0, -4.0]], dtype=np.float32)
    x, y, depth = ahead.project(points)
    assert x[:2].tolist() == [75.0, 60.0]
    assert y.tolist()[:2] == [50.0, 50.0]
    index, _ = splat(ahead, points, (100, 100), 0.01)
    assert index[50, 75] == 0
    assert index[50, 60] == 1
    assert 2 not in index


def test_upper_points_hide_lower_ones_in_any_order() -> None:
    low, high = square(0.0, (255, 0, 0)), square(1.0, (0, 0, 255))
    pictures = [
        render_cloud(PointCloud.concatenate(order), view=View.TOP, options=OPTIONS)
        for order in ([low, high], [high, low])
    ]
    np.testing.assert_array_equal(pictures[0], pictures[1])
    assert pictures[0][50, 100].tolist() == [255, 0, 0]  # blue first: OpenCV's order
    solid = (pictures[0][20:80, 70:130] == [255, 0, 0]).all(axis=2)
    assert solid.all()


def test_the_oblique_eye_stands_in_the_south_west() -> None:
    """A red post in the south-west hides a blue one behind it in the north-east."""
    ground = square(0.0, (200, 200, 200))
    heights = np.linspace(0.0, 0.5, 30)
    posts = []
    for x, color in ((-1.0, (255, 0, 0)), (1.0, (0, 0, 255))):
        at = np.array([np.cos(np.radians(235)), np.sin(np.radians(235))]) * -x
        points = np.stack([np.full(30, at[0]), np.full(30, at[1]), heights], axis=1).astype(np.float32)
        posts.append(PointCloud(points, None, np.tile(np.array(color, dtype=np.uint8), (30, 1))))
    image = render_cloud(PointCloud.concatenate([ground, *posts]), options=OPTIONS).astype(int)
    red_rows = np.flatnonzero((image[..., 2] - image[..., 0] > 100).any(axis=1))
    blue_rows = np.flatnonzero((image[..., 0] - image[..., 2] > 100).any(axis=1))
    assert red_rows.mean() > blue_rows.mean() + 10


def test_seen_from_above_north_is_up_and_east_is_right() -> None:
    cloud = square(0.0, (60, 60, 60))
    colors = cloud.colors
    assert colors is not None
    colors[(cloud.points[:, 0] > 1) & (cloud.points[:, 1] > 1)] = (0, 255, 0)
    image = render_cloud(cloud, view=View.TOP, options=OPTIONS).astype(int)
    rows, columns = np.nonzero(image[..., 1] > 200)
    assert rows.max() < 50
    assert columns.min() > 100


@pytest.mark.parametrize("view", list(View))
def test_the_whole_cloud_fits(view: View) -> None:
    cloud = square(0.0, (255, 255, 255))
    projection = fit_projection(cloud.points, view, OPTIONS)
    x, y, depth = projection.project(cloud.points)
    inside = (x > 0) & (x < 200) & (y > 0) & (y < 100) & (depth > 0)
    assert inside.mean() > 0.97
    assert np.ptp(y) > 60 or np.ptp(x) > 120


def test_small_holes_close_and_large_ones_stay() -> None:
    cloud = square(0.0, (0, 255, 0), n=161)
    near_centre = np.linalg.norm(cloud.points[:, :2], axis=1)
    drilled = cloud.select((near_centre > 0.7) & (np.arange(len(cloud)) % 9 != 0))
    image = render_cloud(drilled, view=View.TOP, options=OPTIONS)
    assert image[50, 100, 1] < 100
    assert (image[20:25, 70:130, 1] > 200).all()


def test_colours_by_height_without_colours_and_shading_darkens() -> None:
    steps = [square(height, (0, 0, 0)).points * np.float32(1 - height) for height in np.linspace(0.0, 0.6, 13)]
    bare = PointCloud(np.concatenate(steps))
    flat = render_cloud(bare, options=OPTIONS).astype(int)
    shaded = render_cloud(bare, options=PictureOptions(width_px=200, height_px=100)).astype(int)
    assert len(np.unique(flat.reshape(-1, 3), axis=0)) > 10
    assert shaded.sum() < flat.sum()


def test_error_colours_run_from_blue_to_red() -> None:
    low, high, beyond = error_colors(np.array([0.0, 0.2, 9.0], dtype=np.float32), 0.2).astype(int)
    assert low[2] > low[0] + 100
    assert high[0] > high[2] + 100
    assert high.tolist() == beyond.tolist()


def test_picture_files(tmp_path: Path) -> None:
    cloud = square(0.0, (10, 200, 30))
    draw_side_by_side(tmp_path / "both.png", [("merged", cloud), ("batch", square(0.2, (200, 0, 0)))], options=OPTIONS)
    both = cv2.imread(str(tmp_path / "both.png"))
    assert both.shape == (34 + 2 * 100, 2 * 200 + 6, 3)
    assert both[34 + 100 + 50, 100].tolist() == [30, 200, 10]
    assert both[34 + 100 + 50, 306].tolist() == [0, 0, 200]
    draw_errors(tmp_path / "error.png", cloud, np.zeros(len(cloud), dtype=np.float32), options=OPTIONS)
    assert cv2.imread(str(tmp_path / "error.png")).shape == (34 + 100 + 46, 200, 3)
    with pytest.raises(FusionError, match="without points"):
        render_cloud(cloud.select(np.empty(0, dtype=np.int64)))
