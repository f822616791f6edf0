"""Models that have images in other places don't agree; other gauges, extra images and a few outliers don't matter."""

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray

from app.sfm.agreement import positions_agree

CORNER = np.array([[min(i, 10), max(i - 10, 0), 0.0] for i in range(21)])
"""A drive along x, then along y."""
LINE = np.linspace([0.0, 0.0, 0.0], [20.0, 0.0, 0.0], 21)
GAUGE = pycolmap.Sim3d(0.1, pycolmap.Rotation3d(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])), [5.0, 6.0, 7.0])


def model(positions: NDArray[np.float64]) -> pycolmap.Reconstruction:
    result = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 90.0, 100, 80)
    result.add_camera_with_trivial_rig(camera)
    for index, position in enumerate(positions):
        image = pycolmap.Image(name=f"{index:02d}.jpg", camera_id=1, image_id=index + 1)
        result.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(), -position))
    return result


@pytest.mark.parametrize("path", [CORNER, LINE])
def test_the_same_drive_in_another_gauge(path: NDArray[np.float64]) -> None:
    other = model(path + np.random.default_rng(0).normal(0, 0.05, path.shape))
    other.transform(GAUGE)
    assert positions_agree(model(path[:12]), other)
    assert positions_agree(other, model(path[:12]))


def test_a_few_outliers_are_no_disagreement() -> None:
    moved = CORNER.copy()
    moved[[3, 8]] += 30.0
    assert positions_agree(model(CORNER), model(moved))


def test_a_bent_drive_disagrees() -> None:
    bent = CORNER.copy()
    bent[11:, 1] *= 0.4
    assert not positions_agree(model(CORNER), model(bent))
    assert not positions_agree(model(CORNER), model(np.random.default_rng(1).permutation(CORNER)))


def test_too_few_shared_images_say_nothing() -> None:
    assert positions_agree(model(CORNER[:4]), model(CORNER[:4][::-1] ** 2))
