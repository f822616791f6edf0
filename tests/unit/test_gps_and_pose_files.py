"""Tables of GPS positions and files of poses: what is read, what fits which frame, and which line is wrong."""

from pathlib import Path

import numpy as np
import pytest

from app.capture.gps import assign_gps, mean_position, read_gps_file
from app.capture.inventory import FrameEntry
from app.capture.poses import PoseFormat, match_poses, read_pose_file
from app.errors import InputError

RIG = [FrameEntry(name=f"{i:06d}", images={c: f"{c}/{i:06d}.jpg" for c in ("cam0", "cam1")}) for i in range(0, 10, 2)]


def table(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "gps.csv"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    "text",
    [
        "frame,lat,lon,alt\n000002,1.5,2.5,3.5\n",
        "\ufeffFrame; Latitude; Longitude; Altitude\n\n2;1.5;2.5;3.5\n",
        "# name\tlng\tlat\tele\tspeed\ncam1/000002.jpg\t2.5\t1.5\t3.5\t9\n# a comment\n",
        "index lat_deg lon_deg alt_m\n2 1.5 2.5 3.5\n",
        'filename,lat,lon,height\n"000002.jpg",1.5,2.5,3.5\r\n',
        "image,lat,lon,alt\ncam0/000002.jpg,1,2,3\ncam1/000002.jpg,2,3,4\n",
    ],
)
def test_gps_tables_of_many_kinds(tmp_path: Path, text: str) -> None:
    assert assign_gps(RIG, read_gps_file(table(tmp_path, text))) == {"000002": (1.5, 2.5, 3.5)}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("frame,lat,lon\n", "no positions"),
        ("lat,lon\n1,2\n", "needed are one of"),
        ("frame,lat\n1,2\n", "needed are one of"),
        ("frame,lat,lon\n0,1,2\n2,1\n", "line 3: 2 values where the header has 3"),
        ("frame,lat,lon\n0,1,2\n\n2,north,2\n", "line 4: 'north' in column 'lat'"),
        ("frame,lat,lon\n0,nan,2\n", "line 2: 'nan'"),
        ("frame,lat,lon\n0,91,2\n", "line 2: lat 91 is not between"),
        ("frame,lat,lon\n0,1,181\n", "line 2: lon 181 is not between"),
        ("frame,lat,lon,alt\n0,1,2,high\n", "line 2: 'high' in column 'alt'"),
        ("frame,lat,lon\n0,1,2\n0,1,2\n", "line 3: '0' was already given in line 2"),
        ("frame,lat,lon\n,1,2\n", "line 2: no frame"),
        ("time_s,lat,lon\n1,1,2\n1,1,2\n", "line 3: its time is not after"),
    ],
)
def test_bad_gps_tables_name_the_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError) as caught:
        read_gps_file(table(tmp_path, text))
    assert message in str(caught.value) and "gps.csv" in str(caught.value) and "\n" not in str(caught.value)


def test_gps_by_time_is_for_videos_only(tmp_path: Path) -> None:
    gps = read_gps_file(table(tmp_path, "time_s,lat,lon,alt\n0,1,179.5,\n2,2,-179.5,4\n"))
    with pytest.raises(InputError, match="only frames of videos have times"):
        assign_gps(RIG, gps)
    frames = [FrameEntry(name=str(i), images={"": f"{i}.jpg"}, time_s=float(i)) for i in range(4)]
    found = assign_gps(frames, gps)
    assert set(found) == {"0", "1", "2"}
    assert found["1"][:2] == pytest.approx((1.5, -180.0)) and np.isnan(found["1"][2])
    assert found["2"] == pytest.approx((2.0, -179.5, 4.0))


GPX = """<?xml version="1.0"?>
<gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>
 <trkpt lat="1.0" lon="20.0"><ele>5.5</ele><time>2024-05-01T10:00:00Z</time></trkpt>
 <trkpt lat="9.0" lon="29.0"><time>2024-05-01T10:00:00Z</time></trkpt>
 <trkpt lat="9.0" lon="29.0"/>
</trkseg><trkseg>
 <trkpt lat="2.0" lon="21.0"><ele>7.5</ele><time>2024-05-01T12:00:02.500+02:00</time></trkpt>
</trkseg></trk></gpx>
"""


def test_a_gpx_track_starts_with_the_video(tmp_path: Path) -> None:
    path = tmp_path / "ride.GPX"
    path.write_text(GPX)
    frames = [FrameEntry(name=str(i), images={"": f"{i}.jpg"}, time_s=float(i)) for i in range(4)]
    found = assign_gps(frames, read_gps_file(path))
    assert found == {
        "0": (1.0, 20.0, 5.5),
        "1": pytest.approx((1.4, 20.4, 6.3)),
        "2": pytest.approx((1.8, 20.8, 7.1)),
    }
    with pytest.raises(InputError, match="exiftool"):
        assign_gps(RIG, read_gps_file(path))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("</gpx>", "", "is not a GPX file"),
        ("trkpt", "wpt", "has 0 track points with times"),
        ('lat="2.0"', 'lat="92.0"', r"track point 4: \(92, 21\) is no place"),
        ('lat="2.0"', "", "track point 4: could not convert"),
        ("12:00:02", "25:00:02", "track point 4: hour"),
    ],
)
def test_gpx_that_cannot_be_used(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = tmp_path / "ride.gpx"
    path.write_text(GPX.replace(old, new))
    with pytest.raises(InputError, match=message):
        read_gps_file(path)


def test_a_number_means_one_image_of_each_camera_that_is_no_rig(tmp_path: Path) -> None:
    frames = [FrameEntry(name=f"{c}/{n}.jpg", images={c: f"{c}/{n}.jpg"}) for c in "ab" for n in ("01", "02")]
    expected = {f"{c}/02.jpg": (1.0, 2.0, 3.0) for c in "ab"}
    for key in ("02", "2", "02.jpg"):
        assert assign_gps(frames, read_gps_file(table(tmp_path, f"frame,lat,lon,alt\n{key},1,2,3\n"))) == expected


def test_numbers_that_mean_several_images_of_a_camera_fit_none(tmp_path: Path) -> None:
    frames = [FrameEntry(name=f"b/{n}.jpg", images={"b": f"b/{n}.jpg"}) for n in ("01", "left1")]
    with pytest.raises(InputError, match="fits a frame"):
        assign_gps(frames, read_gps_file(table(tmp_path, "frame,lat,lon\n1,1,2\n")))
    assert assign_gps(frames, read_gps_file(table(tmp_path, "name,lat,lon,alt\nb/01.jpg,1,2,3\n"))) == {
        "b/01.jpg": (1.0, 2.0, 3.0)
    }


def test_mean_position_across_the_date_line() -> None:
    lat, lon, height = mean_position([(0.0, 179.9, 1.0), (1.0, -179.9, float("nan"))])
    assert (lat, abs(lon), height) == (0.5, pytest.approx(180.0), 1.0)


KITTI_LINE = "1 0 0 {} 0 1 0 {} 0 0 1 {}"


def test_kitti_lines_are_frame_numbers(tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    path.write_text("".join(KITTI_LINE.format(i, 0, 0) + "\n" for i in range(10)))
    poses = read_pose_file(path)
    assert poses.format is PoseFormat.KITTI and poses.is_metric
    found = match_poses(poses, RIG)
    assert {name: pose[0, 3] for name, pose in found.items()} == {f"cam0/{i:06d}.jpg": i for i in range(0, 10, 2)}
    assert set(match_poses(poses, RIG, reference_camera="cam1")) == {f"cam1/{i:06d}.jpg" for i in range(0, 10, 2)}


def test_as_many_kitti_lines_as_frames_go_in_order(tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    path.write_text("".join(KITTI_LINE.format(i, 0, 0) + "\n" for i in range(5)))
    found = match_poses(read_pose_file(path), RIG)
    assert [found[f"cam0/{number:06d}.jpg"][0, 3] for number in range(0, 10, 2)] == [0, 1, 2, 3, 4]
    path.write_text("".join(KITTI_LINE.format(i, 0, 0) + "\n" for i in range(4)))
    with pytest.raises(InputError, match="none of its 4 poses"):
        match_poses(read_pose_file(path), RIG)


def test_tum_by_time_stamp(tmp_path: Path) -> None:
    path = tmp_path / "trajectory.txt"
    path.write_text("# t x y z q\n10.500 1 2 3 0 0 0.70710678 0.70710678\n10.000 7 8 9 0 0 0 1\n")
    frames = [FrameEntry(name=name, images={"": name}) for name in ("10.005.png", "10.51.png", "11.png")]
    poses = read_pose_file(path)
    assert poses.format is PoseFormat.TUM
    found = match_poses(poses, frames)
    assert set(found) == {"10.005.png", "10.51.png"}
    assert found["10.51.png"][:3, 3].tolist() == [1, 2, 3]
    # world_from_cam turns the camera's x axis into the world's y axis.
    assert found["10.51.png"][:3, 0] == pytest.approx([0, 1, 0], abs=1e-8)
    video = [FrameEntry(name=f"cam0/{i}.jpg", images={"cam0": f"cam0/{i}.jpg"}, time_s=10.0 + i / 4) for i in range(3)]
    assert set(match_poses(poses, video)) == {"cam0/0.jpg", "cam0/2.jpg"}


def test_colmap_images_by_name(tmp_path: Path) -> None:
    path = tmp_path / "images.txt"
    path.write_text(
        "# Image list\n1 1 0 0 0 1 2 3 1 cam0/000002.jpg\n\n2 0 1 0 0 1 2 3 2 cam1/a b.jpg\n100 200 1 50 60 -1\n"
    )
    poses = read_pose_file(path)
    assert poses.format is PoseFormat.COLMAP and not poses.is_metric
    assert poses.keys == ("cam0/000002.jpg", "cam1/a b.jpg")
    assert poses.world_from_cam[:, :3, 3].tolist() == [[-1, -2, -3], [-1, 2, 3]]
    assert set(match_poses(poses, RIG)) == {"cam0/000002.jpg"}
    assert np.allclose(poses.cam_from_world @ poses.world_from_cam, np.eye(4))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no poses"),
        ("1 2 3\n", "3 values is no known pose format"),
        (KITTI_LINE.format(0, 0, 0) + "\n1 2 3\n", "line 2: needs 12 finite numbers"),
        (KITTI_LINE.format("nan", 0, 0) + "\n", "line 1: needs 12 finite numbers"),
        ("2 0 0 0 0 2 0 0 0 0 2 0\n", "line 1: its 3 x 3 part is not a rotation"),
        ("1 0 0 0 0 1 0 0 0 0 -1 0\n", "line 1: its 3 x 3 part is not a rotation"),
        ("1 0 0 0 0 0 0 0\n", "line 1: its quaternion has length 0"),
        ("1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "a timestamp is there twice"),
    ],
)
def test_bad_pose_files_name_the_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "poses.txt"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        read_pose_file(path)
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_files_that_are_no_text(tmp_path: Path) -> None:
    path = tmp_path / "gps.csv"
    path.write_bytes(b"\xff\xfe\x00binary")
    with pytest.raises(InputError, match="not a text file"):
        read_gps_file(path)
    with pytest.raises(InputError, match="cannot read"):
        read_pose_file(tmp_path / "absent.txt")
