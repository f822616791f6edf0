"""Where a rig's frames were, although one of its cameras has a bad track."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from app.capture.inventory import CameraEntry, FrameEntry, ImageEntry, Inventory
from app.georegister.frames import model_frames
from tests.reference.posed_scenes import make_scene

NUM_FRAMES = 11
BESIDE = {"back": 0.0, "left": 0.5, "right": 1.0}
"""Places of the cameras along x; all look along z."""


def test_one_bad_track_does_not_bend_the_drive() -> None:
    """The reference camera's drive is a tenth too long; the other two outvote it."""
    drive = np.linspace(-10.0, 10.0, NUM_FRAMES)
    poses = {}
    for camera, x in BESIDE.items():
        for number, z in enumerate(drive):
            center = np.array([x, 0.0, 1.1 * z if camera == "back" else z])
            poses[f"{camera}/{number:02d}.jpg"] = np.column_stack([np.eye(3), -center])
    inventory = Inventory(
        image_root=Path("images"),
        cameras=tuple(CameraEntry(name=name, width=100, height=80, num_images=NUM_FRAMES) for name in BESIDE),
        frames=tuple(
            FrameEntry(name=f"{n:02d}", images={camera: f"{camera}/{n:02d}.jpg" for camera in BESIDE})
            for n in range(NUM_FRAMES)
        ),
        images=tuple(ImageEntry(name=name, size_bytes=1, digest="") for name in sorted(poses)),
        is_rig=True,
    )
    frames = model_frames(make_scene(poses, [[0.0, 0.0, 50.0]]), inventory)
    expected = np.column_stack([np.zeros(NUM_FRAMES), np.zeros(NUM_FRAMES), drive])
    np.testing.assert_allclose(frames.positions_in_model, expected, atol=1e-9)
