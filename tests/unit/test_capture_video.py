"""Frames from videos of a scene that moves, stands still, and moves again."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from app.capture.capture import capture
from app.capture.inventory import Inventory
from app.capture.options import CaptureOptions
from app.errors import InputError

FRAME_RATE = 20.0
MOVING = [*range(40), *[40] * 40, *range(40, 80)]
"""Position at each video frame, pixels: 2 s of driving, 2 s of standing, 2 s of driving."""


def write_video(path: Path, positions: list[int], *, seed: int = 0, passing_bus: bool = False) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed)
    scene = cv2.GaussianBlur(rng.integers(0, 256, (120, 400, 3), dtype=np.uint8), (5, 5), 0)
    bus = cv2.GaussianBlur(rng.integers(0, 256, (120, 400, 3), dtype=np.uint8), (5, 5), 0)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), FRAME_RATE, (160, 120))
    assert writer.isOpened()
    for index, position in enumerate(positions):
        picture = scene[:, position : position + 160].copy()
        if passing_bus:
            picture[50:] = bus[50:, 2 * index : 2 * index + 160]
        noise = rng.normal(0.0, 1.5, picture.shape)
        writer.write(np.clip(picture + noise, 0, 255).astype(np.uint8))
    writer.release()


def take(source: Path, tmp_path: Path, options: CaptureOptions | None = None, gps: Path | None = None) -> Inventory:
    return capture(source, tmp_path / "ws" / "capture", options=options or CaptureOptions(), gps_file=gps)


def numbers(inventory: Inventory) -> list[int]:
    return [int(Path(next(iter(frame.images.values()))).stem) for frame in inventory.frames]


def test_single_video_without_the_stop(tmp_path: Path) -> None:
    write_video(tmp_path / "drive.mp4", MOVING)
    inventory = take(tmp_path / "drive.mp4", tmp_path)
    found = numbers(inventory)
    assert found[:8] == list(range(0, 40, 5))
    assert not [number for number in found if 45 < number < 80], "frames of the stop were kept"
    assert [number for number in found if number >= 80][0] <= 85 and len(found) in (15, 16, 17)
    assert inventory.frames[1].time_s == pytest.approx(0.25, abs=0.01)
    assert inventory.image_root == tmp_path / "ws" / "capture" / "frames"
    assert inventory.video_frame_interval_s == 0.25
    everything = take(tmp_path / "drive.mp4", tmp_path, CaptureOptions(video_min_displacement=0.0))
    assert numbers(everything) == list(range(0, 120, 5))


def test_the_folder_may_be_renamed(tmp_path: Path) -> None:
    write_video(tmp_path / "drive.mp4", MOVING)
    capture(tmp_path / "drive.mp4", tmp_path / "ws" / "capture.partial", options=CaptureOptions())
    (tmp_path / "ws" / "capture.partial").rename(tmp_path / "ws" / "capture")
    inventory = Inventory.read(tmp_path / "ws" / "capture" / "inventory.json")
    assert inventory.image_root == tmp_path / "ws" / "capture" / "frames"
    assert all((inventory.image_root / image.name).is_file() for image in inventory.images)


def test_one_video_per_camera(tmp_path: Path) -> None:
    """A bus fills most of one camera's view all the time; the two others tell that the vehicle stands."""
    write_video(tmp_path / "in" / "left.mp4", MOVING, seed=1)
    write_video(tmp_path / "in" / "front.avi", MOVING, seed=2)
    write_video(tmp_path / "in" / "right.mp4", MOVING, seed=3, passing_bus=True)
    inventory = take(tmp_path / "in", tmp_path)
    assert inventory.is_rig
    assert [camera.name for camera in inventory.cameras] == ["front", "left", "right"]
    assert all(len(frame.images) == 3 for frame in inventory.frames)
    assert not [number for number in numbers(inventory) if 45 < number < 80]


def test_interrupted_extraction_ends_with_the_same_frames(tmp_path: Path) -> None:
    write_video(tmp_path / "drive.mp4", MOVING)
    whole = take(tmp_path / "drive.mp4", tmp_path)
    before = {image.name: (whole.image_root / image.name).read_bytes() for image in whole.images}
    folder = whole.image_root / "cam0"
    for path in sorted(folder.iterdir())[4:]:
        path.unlink()
    (folder / ".000099.jpg.partial").write_bytes(b"half")
    (folder / "000099.jpg").write_bytes(b"from other options")
    again = take(tmp_path / "drive.mp4", tmp_path)
    assert again == whole
    assert {path.name for path in folder.iterdir()} == {Path(name).name for name in before}
    assert all((whole.image_root / name).read_bytes() == data for name, data in before.items())


def test_frames_every_so_many_metres(tmp_path: Path) -> None:
    """1 m/s for 3 s, then 3 m/s: frames every 1.5 m, by positions with time."""
    write_video(tmp_path / "drive.mp4", list(range(120)))
    metre = np.degrees(1.0 / 6_371_000.0)
    times = np.arange(0.0, 6.01, 0.5)
    path_m = np.where(times < 3.0, times, 3.0 + 3.0 * (times - 3.0))
    gps = tmp_path / "gps.csv"
    rows = "".join(f"{time},{distance * metre:.12f},0,0\n" for time, distance in zip(times, path_m, strict=True))
    gps.write_text("time_s,lat,lon,alt\n" + rows)
    inventory = take(tmp_path / "drive.mp4", tmp_path, CaptureOptions(video_spacing_m=1.5), gps)
    assert numbers(inventory) == [0, 30, 60, 70, 80, 90, 100, 110]
    assert inventory.frames[1].gps is not None
    assert inventory.frames[1].gps[0] == pytest.approx(1.5 * metre, abs=0.06 * metre)


def test_metres_without_gps_fall_back_to_seconds(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_video(tmp_path / "drive.mp4", list(range(60)))
    inventory = take(tmp_path / "drive.mp4", tmp_path, CaptureOptions(video_spacing_m=1.0))
    assert numbers(inventory) == list(range(0, 60, 5))
    assert "no GPS file" in caplog.text


def test_videos_that_cannot_be_used(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "a.mp4").write_bytes(b"no video")
    with pytest.raises(InputError, match=r"a\.mp4 can't be opened"):
        take(tmp_path / "in", tmp_path)
    write_video(tmp_path / "two" / "cam0" / "a.mp4", MOVING[:5])
    write_video(tmp_path / "two" / "cam0" / "b.mp4", MOVING[:5])
    with pytest.raises(InputError, match="holds 2 videos of one camera"):
        take(tmp_path / "two", tmp_path)
    (tmp_path / "notes.txt").write_text("x")
    with pytest.raises(InputError, match="neither a folder nor a video"):
        take(tmp_path / "notes.txt", tmp_path)
    write_video(tmp_path / "still.mp4", [0] * 40)
    with pytest.raises(InputError, match="gives only 1 image"):
        take(tmp_path / "still.mp4", tmp_path)
