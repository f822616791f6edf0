"""Without positions, images of the same place are found by how they look."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap

from app.capture.inventory import FrameEntry
from app.sfm.options import SfmOptions
from app.sfm.retrieval import similar_pairs

NUM_PLACES = 12


def write_loop(path: Path) -> tuple[FrameEntry, ...]:
    """Drive past twelve places twice: frames k and k + 12 see the same descriptors, with noise."""
    generator = np.random.default_rng(3)
    places = generator.gamma(0.5, 40, (NUM_PLACES, 300, 128))
    frames = []
    with pycolmap.Database.open(path) as database:
        camera_id = database.write_camera(pycolmap.Camera.create_from_model_name(0, "PINHOLE", 90.0, 100, 80))
        for number in range(2 * NUM_PLACES):
            name = f"{number:02d}.jpg"
            image_id = database.write_image(pycolmap.Image(name=name, camera_id=camera_id))
            noisy = places[number % NUM_PLACES] + generator.normal(0, 10, (300, 128))
            data = np.clip(noisy[generator.permutation(300)[:250]], 0, 255).astype(np.uint8)
            database.write_descriptors(image_id, pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, data))
            frames.append(FrameEntry(name=name, images={"": name}))
        blank = database.write_image(pycolmap.Image(name="blank.jpg", camera_id=camera_id))
        database.write_descriptors(
            blank,
            pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, np.zeros((0, 128), np.uint8)),
        )
    return (*frames, FrameEntry(name="blank.jpg", images={"": "blank.jpg"}))


def test_a_place_seen_again_comes_first(tmp_path: Path) -> None:
    frames = write_loop(tmp_path / "database.db")
    options = SfmOptions(num_similar_images=1)
    pairs = list(similar_pairs(tmp_path / "database.db", frames, options))
    expected = {(f"{k:02d}.jpg", f"{(k + NUM_PLACES) % (2 * NUM_PLACES):02d}.jpg") for k in range(2 * NUM_PLACES)}
    assert set(pairs) == expected
    assert pairs == list(similar_pairs(tmp_path / "database.db", frames, options))
