"""Inventories of all layouts of input, and the one-line errors for input that can't be used."""

import logging
import os
import struct
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from app.capture.capture import capture
from app.capture.describe import compress_names, describe
from app.capture.inventory import Inventory
from app.capture.options import CaptureOptions, RigMode
from app.capture.scan import natural_key
from app.errors import InputError

OPTIONS = CaptureOptions()


def write_image(path: Path, width: int = 32, height: int = 24, seed: int = 0) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)
    assert cv2.imwrite(str(path), pixels)


def take(tmp_path: Path, **arguments: Path | None) -> Inventory:
    return capture(tmp_path / "images", tmp_path / "ws" / "capture", options=OPTIONS, **arguments)


def refused(tmp_path: Path, **arguments: Path | None) -> str:
    with pytest.raises(InputError) as caught:
        take(tmp_path, **arguments)
    message = str(caught.value)
    assert "\n" not in message
    return message


def rig_folder(root: Path, frames: int = 4) -> None:
    for camera in ("cam0", "cam1"):
        for frame in range(frames):
            write_image(root / camera / f"{frame:03d}.png", seed=frame)


def test_flat_folder_in_natural_order(tmp_path: Path) -> None:
    for name in ("a2.jpg", "a10.PNG", "a1.JPEG", "b.tif", "c.bmp", "d.webp"):
        write_image(tmp_path / "images" / name)
    for name in ("Readme.txt", "K.txt", ".hidden.jpg", ".git/x.jpg"):
        (tmp_path / "images" / name).parent.mkdir(exist_ok=True)
        (tmp_path / "images" / name).write_text("no image")
    inventory = take(tmp_path)
    assert [frame.name for frame in inventory.frames] == ["a1.JPEG", "a2.jpg", "a10.PNG", "b.tif", "c.bmp", "d.webp"]
    assert [image.name for image in inventory.images] == sorted(frame.name for frame in inventory.frames)
    assert not inventory.is_rig
    assert inventory.image_root == (tmp_path / "images").resolve()
    (camera,) = inventory.cameras
    assert (camera.name, camera.width, camera.height, camera.num_images) == ("", 32, 24, 6)
    assert Inventory.read(tmp_path / "ws" / "capture" / "inventory.json") == inventory


def test_camera_folders_are_a_rig(tmp_path: Path) -> None:
    rig_folder(tmp_path / "images" / "day 1")
    (tmp_path / "images" / "day 1" / "cam1" / "002.png").unlink()
    inventory = take(tmp_path)
    assert inventory.is_rig
    assert [camera.name for camera in inventory.cameras] == ["day 1/cam0", "day 1/cam1"]
    assert [frame.name for frame in inventory.frames] == ["000", "001", "002", "003"]
    assert inventory.frames[2].images == {"day 1/cam0": "day 1/cam0/002.png"}
    text = describe(inventory)
    assert "2 cameras (a rig), 4 frames, 7 images" in text
    assert "day 1/cam0: 4 images of 32x24; none missing" in text
    assert "day 1/cam1: 3 images of 32x24; missing 1: 002" in text


def test_folders_that_share_few_names_are_no_rig(tmp_path: Path) -> None:
    for camera in ("cam0", "cam1"):
        for frame in range(4):
            write_image(tmp_path / "images" / camera / f"{camera if frame else 'x'}_{frame}.png")
    inventory = take(tmp_path)
    assert not inventory.is_rig
    assert len(inventory.frames) == 8
    assert inventory.frames[0].name == "cam0/cam0_1.png"
    forced = capture(tmp_path / "images", tmp_path / "ws" / "capture", options=CaptureOptions(rig_mode=RigMode.YES))
    assert forced.is_rig and len(forced.frames) == 7


def test_names_with_spaces_and_unicode(tmp_path: Path) -> None:
    for name in ("Straße 1/Bild ä.jpg", "Straße 1/日本 2.jpg"):
        write_image(tmp_path / "images" / name)
    inventory = take(tmp_path)
    assert {image.name for image in inventory.images} == {"Straße 1/Bild ä.jpg", "Straße 1/日本 2.jpg"}
    assert Inventory.read(tmp_path / "ws" / "capture" / "inventory.json") == inventory


def test_natural_key_compares_any_names() -> None:
    names = ["10", "9", "a", "a10b2", "a10b10", "a9", "", "a²3"]
    assert sorted(names, key=natural_key) == ["", "9", "10", "a", "a9", "a10b2", "a10b10", "a²3"]


def test_compressed_names_follow_the_order_of_frames() -> None:
    names = ["0", "2", "4", "6", "8"]
    assert compress_names(names, [True, True, False, False, True]) == "0-2, 8"
    assert compress_names(names, [False] * 5) == ""
    assert compress_names([str(i) for i in range(40)], [i % 2 == 0 for i in range(40)]).endswith("and 12 more")


def test_empty_missing_and_single(tmp_path: Path) -> None:
    assert "can't be opened" in refused(tmp_path)
    (tmp_path / "images").mkdir()
    assert "no images in" in refused(tmp_path)
    (tmp_path / "images" / "notes.txt").write_text("x")
    assert "no images in" in refused(tmp_path)
    write_image(tmp_path / "images" / "only.jpg")
    assert "only 1 image" in refused(tmp_path)


def test_truncated_and_unreadable_images_are_counted(tmp_path: Path) -> None:
    for name in ("1.jpg", "2.jpg", "3.png", "4.png", "5.bmp", "6.jpg"):
        write_image(tmp_path / "images" / name, 200, 150)
    for name in ("1.jpg", "3.png", "5.bmp"):
        data = (tmp_path / "images" / name).read_bytes()
        (tmp_path / "images" / name).write_bytes(data[: len(data) * 2 // 3])
    (tmp_path / "images" / "7.jpg").write_bytes(b"")
    (tmp_path / "images" / "8.tif").write_bytes(b"not an image at all")
    message = refused(tmp_path)
    assert "5 of 8 images" in message and "first: 1.jpg: the file is truncated" in message


def test_truncated_jpeg_with_a_thumbnail(tmp_path: Path) -> None:
    """The thumbnail's end marker must not pass for the image's."""
    write_image(tmp_path / "images" / "1.jpg", 200, 150)
    write_image(tmp_path / "images" / "2.jpg", 200, 150)
    data = (tmp_path / "images" / "1.jpg").read_bytes()
    segment = b"\xff\xe1" + struct.pack(">H", 2 + 20) + b"Exif\0\0" + b"\xff\xd8 thumb \xff\xd9".ljust(14)
    (tmp_path / "images" / "1.jpg").write_bytes((data[:2] + segment + data[2:])[: len(data) // 2])
    assert "1.jpg: the file is truncated" in refused(tmp_path)


def test_mixed_sizes_in_one_camera(tmp_path: Path) -> None:
    for index in range(3):
        write_image(tmp_path / "images" / f"{index}.jpg")
    write_image(tmp_path / "images" / "9.jpg", 24, 32)
    message = refused(tmp_path)
    assert "32x24 (3), 24x32 (1)" in message and "9.jpg" in message and "folder of its own" in message
    write_image(tmp_path / "images" / "other" / "9.jpg", 24, 32)
    (tmp_path / "images" / "9.jpg").unlink()
    assert len(take(tmp_path).cameras) == 2


def test_same_stem_twice(tmp_path: Path) -> None:
    write_image(tmp_path / "images" / "a.jpg")
    write_image(tmp_path / "images" / "a.png")
    assert "a.jpg and a.png" in refused(tmp_path)


def test_links_that_leave_the_folder(tmp_path: Path) -> None:
    rig_folder(tmp_path / "images")
    write_image(tmp_path / "secret" / "x.jpg")
    link = tmp_path / "images" / "cam0" / "x.jpg"
    link.symlink_to(tmp_path / "secret" / "x.jpg")
    assert "cam0/x.jpg ->" in refused(tmp_path) and "1 link(s)" in refused(tmp_path)
    link.unlink()
    (tmp_path / "images" / "cam2").symlink_to(tmp_path / "secret")
    assert "cam2 ->" in refused(tmp_path)
    (tmp_path / "images" / "cam2").unlink()
    (tmp_path / "images" / "again").symlink_to(tmp_path / "images" / "cam0")
    assert len(take(tmp_path).cameras) == 2


def test_unprintable_names(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    write_image(tmp_path / "images" / "ok.jpg")
    os.rename(tmp_path / "images" / "ok.jpg", os.fsencode(tmp_path / "images") + b"/bad\xff.jpg")  # noqa: PTH104
    assert "rename it" in refused(tmp_path)


def test_workspace_and_masks_inside_the_folder_are_not_images(tmp_path: Path) -> None:
    rig_folder(tmp_path / "images")
    write_image(tmp_path / "images" / "ws" / "dense" / "picture.png")
    for name in ("cam0/000.png", "cam1/003.png"):
        write_image(tmp_path / "images" / "masks" / f"{name}.png")
    inventory = capture(
        tmp_path / "images",
        tmp_path / "images" / "ws" / "capture",
        options=OPTIONS,
        mask_dir=tmp_path / "images" / "masks",
    )
    assert len(inventory.images) == 8
    with_masks = capture(tmp_path / "images", tmp_path / "images" / "ws" / "capture", options=OPTIONS)
    assert {camera.name for camera in with_masks.cameras} == {"cam0", "cam1", "masks/cam0", "masks/cam1"}
    assert {image.name for image in inventory.images if image.has_mask} == {"cam0/000.png", "cam1/003.png"}
    assert "masks: 2 of 8 images" in describe(inventory)
    with pytest.raises(InputError, match="is the image folder itself"):
        capture(tmp_path / "images", tmp_path / "images" / "capture", options=OPTIONS)


def test_masks_that_fit_nothing(tmp_path: Path) -> None:
    rig_folder(tmp_path / "images")
    masks = tmp_path / "masks"
    write_image(masks / "cam0" / "000.png")
    assert "000.png.png" in refused(tmp_path, mask_dir=masks)
    write_image(masks / "cam0" / "000.png.png", 10, 10)
    assert "10x10" in refused(tmp_path, mask_dir=masks)
    (masks / "cam0" / "000.png.png").write_bytes(b"text")
    assert "is no PNG file" in refused(tmp_path, mask_dir=masks)


def test_no_write_permission(tmp_path: Path) -> None:
    rig_folder(tmp_path / "images")
    (tmp_path / "ws").write_text("a file where the workspace should be")
    assert "cannot write" in refused(tmp_path)


def test_rig_file(tmp_path: Path) -> None:
    rig_folder(tmp_path / "images")
    rig = tmp_path / "rig_config.json"
    rig.write_text('[{"cameras": [{"image_prefix": "cam0/", "ref_sensor": true}, {"image_prefix": "camX/"}]}]')
    assert "'camX/'" in refused(tmp_path, rig_file=rig)
    for text in ("", "{", "[]", '{"a": 1}', '[{"cameras": [{"image_prefix": "cam0/"}]}]'):
        rig.write_text(text)
        assert str(rig) in refused(tmp_path, rig_file=rig)
    rig.write_text(
        '[{"cameras": [{"image_prefix": "cam0/", "ref_sensor": true}, {"image_prefix": "cam1/", '
        '"cam_from_rig_rotation": [0, 0, 0, 0], "cam_from_rig_translation": [1, 0, 0]}]}]'
    )
    assert "unit quaternion" in refused(tmp_path, rig_file=rig)
    rig.write_text('[{"cameras": [{"image_prefix": "cam0/", "ref_sensor": true}, {"image_prefix": "cam1/"}]}]')
    assert take(tmp_path, rig_file=rig).rig_file == rig


def test_gps_and_poses_of_frames(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    rig_folder(tmp_path / "images")
    gps = tmp_path / "gps.csv"
    gps.write_text("frame,lat,lon,alt\n" + "".join(f"{i},44.8,{10.0 + i},50\n" for i in range(3)) + "77,44,10,1\n")
    poses = tmp_path / "poses.txt"
    poses.write_text("".join(f"1 0 0 {i} 0 1 0 5 0 0 1 {2 * i}\n" for i in range(6)))
    with caplog.at_level(logging.INFO):
        inventory = take(tmp_path, gps_file=gps, pose_file=poses)
    assert [frame.gps for frame in inventory.frames] == [(44.8, 10.0 + i, 50.0) for i in range(3)] + [None]
    assert [frame.position_m for frame in inventory.frames] == [(i, 5.0, 2.0 * i) for i in range(4)]
    assert "1 of 4 rows belong to no frame" in caplog.text
    assert "no position for 1 of 4 frames" in caplog.text
    assert "GPS: 3 of 4 frames" in describe(inventory)
    gps.write_text("frame,lat,lon\n100,1,2\n")
    assert "none of its 1 rows fits a frame" in refused(tmp_path, gps_file=gps)


def exif_jpeg(path: Path, order: str, lat: float, lon: float, height: float) -> None:
    """A JPEG file with a GPS position in its EXIF block."""

    def angle(value: float) -> bytes:
        degrees = int(abs(value))
        minutes = (abs(value) - degrees) * 60.0
        return struct.pack(order + "6I", degrees, 1, int(minutes), 1, round((minutes % 1.0) * 60e6), 10**6)

    data_at = 8 + 18 + 2 + 6 * 12 + 4
    values = (
        (1, 2, 2, (b"S\0" if lat < 0 else b"N\0").ljust(4, b"\0")),
        (2, 5, 3, struct.pack(order + "I", data_at)),
        (3, 2, 2, (b"W\0" if lon < 0 else b"E\0").ljust(4, b"\0")),
        (4, 5, 3, struct.pack(order + "I", data_at + 24)),
        (5, 1, 1, bytes([height < 0]).ljust(4, b"\0")),
        (6, 5, 1, struct.pack(order + "I", data_at + 48)),
    )
    tiff = (b"II" if order == "<" else b"MM") + struct.pack(order + "HI", 42, 8)
    tiff += struct.pack(order + "HHHII", 1, 0x8825, 4, 1, 26) + struct.pack(order + "I", 0)
    tiff += struct.pack(order + "H", len(values))
    tiff += b"".join(struct.pack(order + "HHI", tag, kind, count) + value for tag, kind, count, value in values)
    tiff += struct.pack(order + "I", 0) + angle(lat) + angle(lon)
    tiff += struct.pack(order + "II", round(abs(height) * 1000), 1000)
    write_image(path)
    data = path.read_bytes()
    path.write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", len(tiff) + 8) + b"Exif\0\0" + tiff + data[2:])


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("position", [(55.698, 13.195, 37.0), (-33.9, -70.61, -12.5)])
def test_exif_position_agrees_with_colmaps_reader(
    tmp_path: Path, order: str, position: tuple[float, float, float]
) -> None:
    for name in ("1.jpg", "2.jpg"):
        exif_jpeg(tmp_path / "images" / name, order, *position)
    found = take(tmp_path).frames[0].gps
    assert found == pytest.approx(position, abs=1e-8)
    bitmap = pycolmap.Bitmap.read(tmp_path / "images" / "1.jpg", False)
    assert found == pytest.approx((bitmap.exif_latitude(), bitmap.exif_longitude(), bitmap.exif_altitude()), abs=1e-6)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_exif_orientation_agrees_with_opencvs_reader(tmp_path: Path, order: str, orientation: int) -> None:
    tiff = (b"II" if order == "<" else b"MM") + struct.pack(order + "HI", 42, 8)
    tiff += struct.pack(order + "HHHIHHI", 1, 0x0112, 3, 1, orientation, 0, 0)
    for name in ("1.jpg", "2.jpg"):
        path = tmp_path / "images" / name
        write_image(path)
        data = path.read_bytes()
        path.write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", len(tiff) + 8) + b"Exif\0\0" + tiff + data[2:])
    inventory = take(tmp_path)
    turns = inventory.images[0].quarter_turns
    stored = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    np.testing.assert_array_equal(np.rot90(stored, -turns), cv2.imread(str(path), cv2.IMREAD_COLOR))
    assert ("turned by EXIF orientation: all 2 images" in describe(inventory)) == (orientation != 1)


def test_a_gps_file_takes_the_place_of_exif(tmp_path: Path) -> None:
    for name in ("1.jpg", "2.jpg"):
        exif_jpeg(tmp_path / "images" / name, "<", 10.0, 20.0, 30.0)
    gps = tmp_path / "gps.csv"
    gps.write_text("name;latitude;longitude\n1.jpg;50.5;8.25\n")
    inventory = take(tmp_path, gps_file=gps)
    assert inventory.frames[0].gps is not None and inventory.frames[0].gps[:2] == (50.5, 8.25)
    assert np.isnan(inventory.frames[0].gps[2])
    assert inventory.frames[1].gps is None
    again = Inventory.read(tmp_path / "ws" / "capture" / "inventory.json").frames[0].gps
    assert again is not None and np.isnan(again[2])


@pytest.mark.parametrize(
    "values",
    [
        {"video_interval_s": 0.0},
        {"video_spacing_m": -1.0},
        {"video_min_displacement": 1.0},
        {"video_jpeg_quality": 0},
        {"num_threads": -1},
    ],
)
def test_options_are_checked(values: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(values))):
        CaptureOptions(**values)  # type: ignore[arg-type]
