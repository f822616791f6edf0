"""Whatever a file holds, it is read right or refused with one line."""

import tempfile
from pathlib import Path

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from app.capture.exif import gps_from_exif
from app.capture.gps import read_gps_file
from app.capture.poses import read_pose_file
from app.capture.scan import natural_key
from app.errors import InputError

FAST = settings(max_examples=60, deadline=None, derandomize=True)
LINES = st.lists(st.text(alphabet="0123456789.,;eE+-nameltco# \t\"'", max_size=40), max_size=6)


@FAST
@given(LINES)
def test_any_text_is_read_or_refused(lines: list[str]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "file.txt"
        for header in (
            "",
            "name,lat,lon,alt\n",
            "1 0 0 0 0 1 0 0 0 0 1 0\n",
            "1 0 0 0 0 0 0 1\n",
            "1 1 0 0 0 0 0 0 1 a\n",
        ):
            path.write_text(header + "\n".join(lines), encoding="utf-8")
            for read in (read_gps_file, read_pose_file):
                try:
                    found = read(path)
                except InputError as error:
                    assert "\n" not in str(error)
                else:
                    numbers = found.positions[:, :2] if read is read_gps_file else found.world_from_cam
                    assert np.isfinite(numbers).all()


@FAST
@given(
    st.lists(
        st.tuples(st.floats(-90, 90), st.floats(-180, 180), st.floats(-1e4, 1e4)),
        min_size=1,
        max_size=5,
    )
)
def test_gps_positions_come_back_as_written(positions: list[tuple[float, float, float]]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "gps.csv"
        rows = (f"{row}, {lat!r}, {lon!r}, {alt!r}" for row, (lat, lon, alt) in enumerate(positions))
        path.write_text("frame, lat, lon, alt\n" + "\n".join(rows))
        assert np.array_equal(read_gps_file(path).positions, np.array(positions))


@FAST
@given(st.integers(0, 2**32 - 1), st.integers(1, 5))
def test_all_pose_formats_say_the_same(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    quaternions = rng.normal(size=(count, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    centers = rng.uniform(-1e3, 1e3, (count, 3))
    tum, kitti, colmap = [], [], []
    for index, ((x, y, z, w), center) in enumerate(zip(quaternions, centers, strict=True)):
        axis = np.array([x, y, z])
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        rotation = (w * w - axis @ axis) * np.eye(3) + 2 * np.outer(axis, axis) + 2 * w * cross
        tum.append(" ".join(repr(float(v)) for v in (index, *center, x, y, z, w)))
        kitti.append(" ".join(repr(float(v)) for v in np.column_stack((rotation, center)).ravel()))
        t = -rotation.T @ center
        colmap.append(f"{index} " + " ".join(repr(float(v)) for v in (w, -x, -y, -z, *t)) + f" 1 {index}.jpg\n")
    with tempfile.TemporaryDirectory() as folder:
        found = []
        for name, lines in (("tum", tum), ("kitti", kitti), ("colmap", colmap)):
            path = Path(folder) / name
            path.write_text("\n".join(lines) + "\n")
            poses = read_pose_file(path)
            assert poses.format == name
            found.append(poses.world_from_cam)
        assert np.allclose(found[0], found[1], atol=1e-9) and np.allclose(found[0], found[2], atol=1e-9)
        assert np.allclose(found[0][:, :3, 3], centers)


@FAST
@given(st.binary(max_size=200), st.sampled_from([b"II*\0\x08\0\0\0", b"MM\0*\0\0\0\x08", b""]))
def test_any_exif_block_gives_a_position_or_none(data: bytes, head: bytes) -> None:
    position = gps_from_exif(head + data)
    assert position is None or (abs(position[0]) <= 90 and abs(position[1]) <= 180)


@FAST
@given(st.lists(st.text(max_size=12), max_size=20))
def test_natural_order_does_not_depend_on_the_input_order(names: list[str]) -> None:
    assert sorted(names, key=natural_key) == sorted(sorted(names), key=natural_key)
    numbers = list(range(0, 120, 7))
    assert sorted((f"f{number}" for number in reversed(numbers)), key=natural_key) == [f"f{n}" for n in numbers]
