"""Reading and writing point clouds: layouts that other programs write, and files that can't be used."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest

from fusion.cloud import PlyWriter, PointCloud, read_ply, read_ply_chunks, write_ply
from fusion.errors import CloudFormatError


def some_cloud(n_points: int, seed: int = 0) -> PointCloud:
    rng = np.random.default_rng(seed)
    return PointCloud(
        rng.normal(size=(n_points, 3)).astype(np.float32),
        rng.normal(size=(n_points, 3)).astype(np.float32),
        rng.integers(0, 256, (n_points, 3), dtype=np.uint8),
    )


def test_pieces_make_the_same_file_as_the_whole(tmp_path: Path) -> None:
    cloud = some_cloud(1000)
    write_ply(tmp_path / "whole.ply", cloud)
    with PlyWriter(tmp_path / "pieces.ply", has_normals=True, has_colors=True) as writer:
        for piece in np.array_split(np.arange(1000), 7):
            writer.append(cloud.select(piece))
    assert writer.n_points == 1000
    assert (tmp_path / "pieces.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()


def test_a_broken_off_file_has_no_points(tmp_path: Path) -> None:
    path = tmp_path / "cloud.ply"
    with pytest.raises(KeyError), PlyWriter(path, has_normals=False, has_colors=False) as writer:
        writer.append(some_cloud(10))
        raise KeyError
    with pytest.raises(CloudFormatError, match="no points"):
        read_ply(path)


def test_writer_wants_what_its_header_says(tmp_path: Path) -> None:
    bare = PointCloud(np.zeros((2, 3), dtype=np.float32))
    with (
        pytest.raises(ValueError, match="nx ny nz"),
        PlyWriter(tmp_path / "cloud.ply", has_normals=True, has_colors=False) as writer,
    ):
        writer.append(bare)


def test_chunks_cover_the_file(tmp_path: Path) -> None:
    cloud = some_cloud(25)
    write_ply(tmp_path / "cloud.ply", cloud)
    chunks = list(read_ply_chunks(tmp_path / "cloud.ply", 10))
    assert [len(chunk) for chunk in chunks] == [10, 10, 5]
    np.testing.assert_array_equal(PointCloud.concatenate(chunks).points, cloud.points)


def test_ascii_with_faces_and_further_properties(tmp_path: Path) -> None:
    path = tmp_path / "cloud.ply"
    path.write_text(
        "ply\nformat ascii 1.0\ncomment by hand\nelement camera 1\nproperty float f\nelement vertex 2\n"
        "property double x\nproperty double y\nproperty double z\nproperty float quality\n"
        "property uchar red\nproperty uchar green\nproperty uchar blue\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
        "9.5\n1 2 3 0.5 10 20 30\n-4 5.25 6e1 0.1 255 0 1\n3 0 1 1\n"
    )
    cloud = read_ply(path)
    np.testing.assert_array_equal(cloud.points, np.array([[1, 2, 3], [-4, 5.25, 60]], dtype=np.float32))
    np.testing.assert_array_equal(cloud.colors, [[10, 20, 30], [255, 0, 1]])
    assert cloud.normals is None


@pytest.mark.parametrize("order", ["little", "big"])
def test_binary_after_another_element_with_lists(tmp_path: Path, order: str) -> None:
    sign = "<" if order == "little" else ">"
    header = (
        f"ply\nformat binary_{order}_endian 1.0\nelement face 2\nproperty uchar flag\n"
        "property list uchar int vertex_indices\nelement vertex 3\nproperty double x\nproperty double y\n"
        "property short tag\nproperty double z\n"
        "property float red\nproperty float green\nproperty float blue\nend_header\n"
    )
    faces = b"".join(b"\x07" + bytes([n]) + np.arange(n).astype(sign + "i4").tobytes() for n in (3, 4))
    names = [("x", "f8"), ("y", "f8"), ("tag", "i2"), ("z", "f8"), ("red", "f4"), ("green", "f4"), ("blue", "f4")]
    vertices = np.zeros(3, dtype=[(name, sign + kind) for name, kind in names])
    vertices["x"], vertices["y"], vertices["z"] = [1, 2, 3], [4, 5, 6], [7, 8, 9]
    vertices["red"] = [0.0, 0.5, 1.0]
    path = tmp_path / "cloud.ply"
    path.write_bytes(header.encode() + faces + vertices.tobytes())
    cloud = read_ply(path)
    np.testing.assert_array_equal(cloud.points, [[1, 4, 7], [2, 5, 8], [3, 6, 9]])
    assert cloud.colors is not None
    assert cloud.colors[:, 0].tolist() == [0, 128, 255]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not a PLY file"),
        (b"solid cube\nfacet normal 0 0 1\n", "not a PLY file"),
        (b"ply\nformat ascii 1.0\nelement vertex", "header is damaged"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty quaternion x\nend_header\n1\n", "header is damaged"),
        (b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n", "no points"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1 2\n", "lack x, y or z"),
        (
            b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
            b"end_header\n1 2 3\n4 5\n",
            "ends before its last point",
        ),
        (
            b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
            b"end_header\n1 2 three\n",
            "isn't made of numbers",
        ),
        (
            b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
            b"end_header\n1 nan 3\n",
            "aren't finite",
        ),
    ],
)  # fmt: skip
def test_unusable_files_are_named_in_one_line(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "cloud.ply"
    path.write_bytes(content)
    with pytest.raises(CloudFormatError, match=message) as caught:
        read_ply(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_every_truncation_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "cloud.ply"
    write_ply(path, some_cloud(3))
    content = path.read_bytes()
    for length in range(len(content)):
        path.write_bytes(content[:length])
        with pytest.raises(CloudFormatError):
            read_ply(path)


def test_coordinates_too_large_for_single_precision_are_mentioned(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write_ply(tmp_path / "cloud.ply", PointCloud(np.array([[5e6, 0, 0]], dtype=np.float32)))
    with caplog.at_level(logging.WARNING):
        read_ply(tmp_path / "cloud.ply")
    assert "subtract an origin" in caplog.text


def test_shapes_are_checked() -> None:
    points = np.zeros((4, 3), dtype=np.float32)
    with pytest.raises(ValueError, match="colors must be"):
        PointCloud(points, None, np.zeros((3, 3), dtype=np.uint8))
    with pytest.raises(ValueError, match="points must be"):
        PointCloud(np.zeros((4, 3)))  # type: ignore[arg-type]
    joined = PointCloud.concatenate([PointCloud(points, points), PointCloud(points)])
    assert len(joined) == 8
    assert joined.normals is None
