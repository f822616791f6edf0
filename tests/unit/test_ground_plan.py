"""Pictures of the ground: where things land, and what they look like there."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from app.clustering.grid import outline
from app.clustering.ground_plan import RED, WHITE, GroundPlan, encode_png, legend
from app.clustering.kernels import cover_with_dots, mix_color
from app.clustering.map_labels import MapLabels, round_length
from tests.reference.pictures import plain_cover, plain_mix

BLACK = (0, 0, 0)


def _plan(size_px: tuple[int, int] = (40, 20)) -> GroundPlan:
    """40 m by 20 m, a pixel a metre, unless the image has other sides."""
    return GroundPlan(np.array([100.0, 50.0]), np.array([140.0, 70.0]), size_px)


def _dark(plan: GroundPlan) -> np.ndarray:
    """(H, W) how much of each pixel is painted, of black paint."""
    return 1 - plan.image[..., 0] / 255


def test_x_is_to_the_right_y_is_up_and_the_middle_stays_in_the_middle() -> None:
    pixels = _plan().to_pixels(np.array([[100.5, 69.5, 7.0], [139.5, 50.5, 0.0]]))
    np.testing.assert_allclose(pixels, [[0, 0], [39, 19]])
    wide = _plan((80, 20))
    assert wide.px_per_unit == 1
    np.testing.assert_allclose(wide.to_pixels(np.array([[120.0, 60.0]])), [[39.5, 9.5]])

    above = GroundPlan(np.array([100.0, 50.0]), np.array([140.0, 70.0]), (40, 50), 30)
    np.testing.assert_allclose(above.to_pixels(np.array([[100.5, 50.5]])), [[0, 19]])


@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.25, 0.5), (-0.5, 0.25)])
def test_a_dot_has_its_place_and_area_to_a_fraction_of_a_pixel(offset: tuple[float, float]) -> None:
    plan = _plan()
    at = np.array([[120.5, 60.5]]) + offset
    plan.dots(at, 3.0, BLACK)
    painted = _dark(plan)
    assert painted.sum() == pytest.approx(np.pi * 9, rel=0.03)
    center = [(painted * axis).sum() / painted.sum() for axis in np.indices(painted.shape)[::-1]]
    np.testing.assert_allclose(center, plan.to_pixels(at)[0], atol=0.03)


def test_dots_on_each_other_are_one_and_dots_outside_are_cut_off() -> None:
    once, often = _plan(), _plan()
    once.dots(np.array([[120.0, 60.0]]), 2.0, RED, 0.5)
    often.dots(np.array([[120.0, 60.0]] * 5 + [[99.0, 60.0], [1e9, -1e9]]), 2.0, RED, 0.5)
    np.testing.assert_array_equal(often.image[:, 3:], once.image[:, 3:])
    assert (often.image[:, 0] != 255).any()
    empty = _plan()
    empty.dots(np.empty((0, 2)), 2.0, RED)
    assert (empty.image == 255).all()


@pytest.mark.parametrize("radius_px", [0.3, 1.0, 2.6])
def test_the_kernel_for_dots_equals_its_plain_twin(radius_px: float) -> None:
    pixels = np.random.default_rng(1).uniform([-5.0, -5.0], [45.0, 25.0], (60, 2))
    pixels[:2] = [[np.nan, 3.0], [1e300, 5.0]]
    cover = np.zeros((20, 40), dtype=np.float32)
    cover_with_dots(cover, pixels, radius_px)
    np.testing.assert_allclose(cover, plain_cover(cover.shape, pixels[2:], radius_px), atol=1e-6)


def test_the_kernel_for_colours_equals_its_plain_twin() -> None:
    rng = np.random.default_rng(2)
    image = rng.integers(0, 256, (20, 40, 3)).astype(np.uint8)
    shares = np.clip(rng.uniform(-0.5, 1.5, (20, 40)), 0.0, 1.0).astype(np.float32)
    expected = plain_mix(image, shares, 0.7, RED)
    mix_color(image, shares, 0.7, RED)
    np.testing.assert_allclose(image, expected, atol=1)


def test_haze_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.clustering.ground_plan._CHUNK_POSITIONS", 2)
    plan = _plan()
    plan.haze(np.array([[100.5, 69.5]] + [[110.5, 60.5]] * 3 + [[0.0, 0.0]]), BLACK, 0.5)
    painted = _dark(plan)
    assert painted[0, 0] == pytest.approx(0.5, abs=0.01)
    assert painted[9, 10] == pytest.approx(1 - 0.5**3, abs=0.01)
    assert (painted > 0).sum() == 2


def test_boxes_end_on_whole_pixels_and_are_cut_off_at_the_image() -> None:
    plan = _plan()
    plan.boxes(np.array([[[90.0, 50.0], [105.0, 60.0]], [[130.0, 65.0], [150.0, 99.0]]]), BLACK)
    assert _dark(plan)[10:, :5].all() and _dark(plan)[:5, 30:].all()
    assert _dark(plan).sum() == 5 * 10 + 10 * 5
    far = _plan()
    far.boxes(np.array([[[-90.0, 50.0], [-80.0, 60.0]], [[130.0, 165.0], [150.0, 199.0]]]), BLACK)
    assert not _dark(far).any()


def test_the_outline_of_cells_leaves_out_the_sides_between_them() -> None:
    """Three cells in the shape of an L have eight sides of which none is inside."""
    sides = outline([(0, 0), (1, 0), (0, 1)])
    assert len(sides) == 8
    assert sorted(map(tuple, sides.reshape(-1, 4).tolist())) == sorted(
        [(0, 0, 0, 1), (0, 0, 1, 0), (1, 0, 2, 0), (2, 0, 2, 1), (1, 1, 2, 1), (1, 1, 1, 2), (0, 1, 0, 2), (0, 2, 1, 2)]
    )


@pytest.mark.parametrize(("length", "expected"), [(0.7, 0.5), (1, 1), (4.9, 2), (5, 5), (99, 50), (100, 100)])
def test_scale_bars_have_round_lengths(length: float, expected: float) -> None:
    assert round_length(length) == pytest.approx(expected)


def test_the_scale_bar_has_the_length_that_it_names() -> None:
    plan = GroundPlan(np.zeros(2), np.array([100.0, 100.0]), (500, 500))
    plan.scale_bar(MapLabels())
    row = plan.image[500 - 14, :200, 0] < 128
    assert row.sum() == pytest.approx(20 * 5, abs=3)


def test_a_label_outside_of_the_image_changes_nothing() -> None:
    plan = _plan((100, 80))
    plan.image[:] = 0
    plan.label("x0001_y0002", (10, -30), 0.5)
    plan.label("x0001_y0002", (-200, 40), 0.5)
    assert not plan.image.any()


def test_a_png_holds_the_image_and_names_in_any_script_can_be_written() -> None:
    plan = _plan((400, 200))
    plan.label("Straße 東京.jpg", (10, 100), 0.5)
    legend(plan.image, (4, 40), tuple((kind, RED, kind) for kind in ("dot", "box", "line", "cross")))
    assert (plan.image[20:50] != np.array(WHITE)).any()
    decoded = cv2.imdecode(np.frombuffer(encode_png(plan.image), np.uint8), cv2.IMREAD_COLOR)
    np.testing.assert_array_equal(decoded, plan.image)
