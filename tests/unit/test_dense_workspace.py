"""The workspaces that benchmarks of stereo work in."""

from pathlib import Path

import cv2
import numpy as np
import pycolmap

from benchmarks.dense_workspace import make_workspace


def write_model(folder: Path) -> None:
    """Two images of 320x200 side by side, and a wall of points before them."""
    x, y = np.meshgrid(np.linspace(-3, 3, 10), np.linspace(-2, 2, 10))
    points = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 8.0)])
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(pycolmap.Camera.create(1, pycolmap.CameraModelId.PINHOLE, 200, 320, 200))
    for i in range(2):
        cv2.imwrite(str(folder / f"{i}.png"), np.full((200, 320, 3), 100, np.uint8))
        pixels = 200 * (points[:, :2] - [i, 0]) / points[:, 2:] + [160, 100]
        pose = pycolmap.Rigid3d(np.column_stack([np.eye(3), [-i, 0, 0]]))
        image = pycolmap.Image(name=f"{i}.png", keypoints=pixels, camera_id=1, image_id=i + 1)
        model.add_image_with_trivial_frame(image, pose)
    for index, point in enumerate(points):
        track = pycolmap.Track([pycolmap.TrackElement(i + 1, index) for i in range(2)])
        model.add_point3D(point, track, np.zeros(3, np.uint8))
    (folder / "model").mkdir()
    model.write_binary(str(folder / "model"))


def test_a_workspace_left_with_images_of_another_size_is_made_anew(tmp_path: Path) -> None:
    write_model(tmp_path)
    for size, expected in ((160, (100, 160)), (0, (200, 320)), (80, (50, 80))):
        job = make_workspace(
            tmp_path / "work",
            model=tmp_path / "model",
            images=tmp_path,
            frames=range(2),
            max_image_size_px=size,
        )
        image = cv2.imread(str(job.workspace / "images" / job.views[0].name))
        assert image.shape[:2] == (job.views[0].height, job.views[0].width) == expected
