"""Real images, for who has the sets: CITYRECON_DATA is the folder that holds them."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from fusion.cloud import read_ply
from tests.small_street import cityrecon

DATA = Path(os.environ.get("CITYRECON_DATA", "/nonexistent"))

pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="CITYRECON_DATA names no folder with the data sets")


def test_castle_without_scale(tmp_path: Path) -> None:
    """Eleven photos of a facade: no GPS, no rig, so no metres and no blocks of 20 m."""
    out = tmp_path / "castle.ply"
    options = ["--set", "sfm.max_image_size_px=800", "--max-image-size-px", "320", "--preset", "preview"]
    result = cityrecon("full", DATA / "sceaux_castle" / "images", out, *options)
    assert result.returncode == 0, result.stderr
    assert result.stderr.count("the model is unscaled") == 1
    georegister = tmp_path / "castle.workspace" / "georegister"
    assert not json.loads((georegister / "georeference.json").read_text())["is_metric"]
    model = pycolmap.Reconstruction(georegister / "model")
    images = sorted((model.image(image_id) for image_id in model.reg_image_ids()), key=lambda image: image.name)
    assert len(images) >= 10
    steps = np.linalg.norm(np.diff([image.projection_center() for image in images], axis=0), axis=1)
    assert 0.5 < np.median(steps) < 2.0, "the unit is the spacing of the cameras"
    assert len(read_ply(out)) > 1000


def test_phone_photos_with_positions(tmp_path: Path) -> None:
    workspace = tmp_path / "ws"
    result = cityrecon("capture", DATA / "lund_gps" / "images", workspace)
    assert result.returncode == 0, result.stderr
    inventory = json.loads((workspace / "capture" / "inventory.json").read_text())
    assert len(inventory["images"]) == 29
    assert all(frame["gps"] is not None for frame in inventory["frames"])
