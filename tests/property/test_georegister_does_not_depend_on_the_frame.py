"""SfM leaves position, attitude and scale of its model to chance: nothing that comes out may depend on them."""

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from app.capture.inventory import Inventory
from app.georegister.georegister import georegister
from app.georegister.options import GeoregisterOptions
from tests.street_model import drive, inventory, random_similarity, write_model

TRUTH = drive(16)
NOISE_M = np.random.default_rng(0).normal(0.0, 0.4, (16, 3))


def world_positions(captured: Inventory, seed: int, scale: float) -> NDArray[np.float64]:
    """(16, 3) cam0 in the georegistered world."""
    similarity = random_similarity(seed, scale)
    with tempfile.TemporaryDirectory() as folder:
        write_model(TRUTH, Path(folder) / "sfm", similarity)
        found = georegister(Path(folder) / "sfm", captured, Path(folder) / "out", options=GeoregisterOptions())
    matrix, to_model = np.array(found.world_from_model).reshape(3, 4), similarity.matrix()
    in_model = TRUTH.centers_m[:, 0] @ to_model[:, :3].T + to_model[:, 3]
    return in_model @ matrix[:, :3].T + matrix[:, 3]


@pytest.mark.parametrize("with_gps", [True, False])
@settings(max_examples=8, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**31), scale=st.floats(1e-3, 1e3))
def test_any_similarity_of_the_model_gives_the_same_world(with_gps: bool, seed: int, scale: float) -> None:
    captured = inventory(TRUTH, gps_m=TRUTH.centers_m[:, 0] + NOISE_M if with_gps else None)
    expected = world_positions(captured, 7, 1.0)
    assert np.allclose(world_positions(captured, seed, scale), expected, atol=1e-4)
