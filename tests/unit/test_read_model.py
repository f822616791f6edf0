"""COLMAP models in and out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from app.errors import InputError
from app.scene import model_pieces, read_model
from app.scene.kernels import index_images, index_points
from app.scene.point_index import tile_keys
from app.scene.posed_scene import PosedScene
from app.scene.read_model import read_posed_scene
from app.scene.submodel import write_submodel
from tests.reference.posed_scenes import level_camera, make_scene, random_scene


def _tracks_by_id(scene: PosedScene) -> dict[int, tuple[object, ...]]:
    """All that is known of each point."""
    return {
        int(scene.point_ids[p]): (
            scene.points_in_world[p].tolist(),
            scene.point_colors[p].tolist(),
            scene.point_normals[p].round(5).tolist(),
            scene.track_images[scene.track_offsets[p] : scene.track_offsets[p + 1]].tolist(),
        )
        for p in range(len(scene.point_ids))
    }


def _equal(a: PosedScene, b: PosedScene) -> None:
    assert a.image_names == b.image_names
    np.testing.assert_allclose(a.cam_from_world, b.cam_from_world, atol=1e-12)
    for name in ("image_ids", "camera_ids", "camera_params_px", "camera_sizes_px", "camera_index"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
    assert _tracks_by_id(a) == _tracks_by_id(b)


def _visible_scene() -> PosedScene:
    """Three cameras abreast look along +x at points 10 m ahead, so that each sees all: cam y = -1, 0, 1.

    The image names aren't in the order of the cameras' positions.
    """
    cameras = {name: level_camera([0, y, 0], 0) for name, y in (("b.jpg", -1), ("a.jpg", 0), ("ä/c.jpg", 1))}
    points = [[10, y, z] for y in (-2, 0, 2) for z in (-1, 1)]
    tracks = [
        ["b.jpg", "a.jpg"],
        ["b.jpg", "ä/c.jpg"],
        sorted(cameras),
        sorted(cameras),
        sorted(cameras),
        ["b.jpg"] * 2,
    ]
    return make_scene(cameras, points, [sorted(set(track)) for track in tracks])


def test_round_trip_through_colmap(tmp_path: Path) -> None:
    scene = _visible_scene()
    write_submodel(scene, np.arange(3), np.arange(5), tmp_path / "binary")
    model = pycolmap.Reconstruction(str(tmp_path / "binary"))
    assert model.num_reg_images() == 3
    assert model.num_points3D() == 5
    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() < 1e-6
    (tmp_path / "text").mkdir()
    model.write_text(str(tmp_path / "text"))
    expected = make_scene(
        dict(zip(scene.image_names, scene.cam_from_world, strict=True)),
        scene.points_in_world[:5].tolist(),
        [[scene.image_names[i] for i in scene.track_images[scene.track_offsets[p] : scene.track_offsets[p + 1]]]
         for p in range(5)],
    )  # fmt: skip
    _equal(read_posed_scene(tmp_path / "binary"), expected)
    _equal(read_posed_scene(tmp_path / "text"), expected)


def test_points_need_two_different_images(tmp_path: Path) -> None:
    write_submodel(_visible_scene(), np.arange(3), np.arange(6), tmp_path)
    assert pycolmap.Reconstruction(str(tmp_path)).num_points3D() == 6
    assert read_posed_scene(tmp_path).point_ids.tolist() == [1, 2, 3, 4, 5]


def test_submodel_keeps_what_is_asked_for_and_its_ids(tmp_path: Path) -> None:
    scene = random_scene(3)
    for folder in ("a", "b"):
        write_submodel(scene, np.array([7, 2, 11]), np.arange(0, 200, 2), tmp_path / folder)
    model = pycolmap.Reconstruction(str(tmp_path / "a"))
    assert {image.image_id: image.name for image in model.images.values()} == {
        int(scene.image_ids[row]): scene.image_names[row] for row in (2, 7, 11)
    }
    for image in model.images.values():
        row = int(np.flatnonzero(scene.image_ids == image.image_id)[0])
        np.testing.assert_allclose(image.cam_from_world().matrix(), scene.cam_from_world[row], atol=1e-12)
    for point_id, point in model.points3D.items():
        row = point_id - 1
        assert row % 2 == 0
        track = scene.track_images[scene.track_offsets[row] : scene.track_offsets[row + 1]]
        assert {e.image_id for e in point.track.elements} <= set(scene.image_ids[track].tolist())
    files = sorted(path.name for path in (tmp_path / "a").iterdir())
    assert len(files) == 5
    for name in files:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_cameras_are_undistorted(tmp_path: Path) -> None:
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        camera_id=3, model="SIMPLE_RADIAL", width=640, height=400, params=[320.0, 320.0, 200.0, 0.1]
    )
    model.add_camera_with_trivial_rig(camera)
    model.add_image_with_trivial_frame(pycolmap.Image(name="a.jpg", camera_id=3, image_id=9), pycolmap.Rigid3d())
    model.write_binary(str(tmp_path))
    scene = read_posed_scene(tmp_path)
    expected = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
    assert expected.width != 640
    assert scene.camera_sizes_px.tolist() == [[expected.width, expected.height]]
    np.testing.assert_array_equal(scene.camera_params_px[0], expected.params)
    assert scene.camera_ids.tolist() == [3]


def _model_bytes(folder: Path) -> Path:
    write_submodel(_visible_scene(), np.arange(3), np.arange(6), folder)
    return folder


def test_points_are_stored_by_tile_and_id(tmp_path: Path) -> None:
    write_submodel(random_scene(4), np.arange(24), np.arange(200), tmp_path)
    scene = read_posed_scene(tmp_path)
    keys = tile_keys(scene.points_in_world)
    assert len(np.unique(keys)) > 5
    np.testing.assert_array_equal(np.lexsort((scene.point_ids, keys)), np.arange(len(keys)))


def test_pieces_make_no_difference(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pieces shorter than a record, as long as some, and as long as the file; points sorted a few at a time."""
    write_submodel(random_scene(4), np.arange(24), np.arange(200), tmp_path)
    expected = read_posed_scene(tmp_path)
    for piece_bytes, piece_points in ((70, 1), (1000, 7), (100_000, 150)):
        monkeypatch.setattr(model_pieces, "_PIECE_BYTES", piece_bytes)
        monkeypatch.setattr(read_model, "_PIECE_POINTS", piece_points)
        found = read_posed_scene(tmp_path)
        for name in ("point_ids", "points_in_world", "track_offsets", "track_images", "image_ids", "cam_from_world"):
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)


def test_image_ids_far_apart(tmp_path: Path) -> None:
    """IDs too great for a table that tells the image of an ID."""
    scene = random_scene(4)
    ids = np.arange(1, 25, dtype=np.int64)
    ids[5:] += 4_000_000_000
    write_submodel(replace(scene, image_ids=ids), np.arange(24), np.arange(200), tmp_path / "far")
    write_submodel(scene, np.arange(24), np.arange(200), tmp_path / "near")
    far, near = read_posed_scene(tmp_path / "far"), read_posed_scene(tmp_path / "near")
    np.testing.assert_array_equal(far.track_images, near.track_images)
    np.testing.assert_array_equal(far.image_ids, ids)


def test_two_points_with_the_same_id(tmp_path: Path) -> None:
    path = _model_bytes(tmp_path) / "points3D.bin"
    data = bytearray(path.read_bytes())
    second = 8 + int(index_points(np.frombuffer(data[8:], dtype=np.uint8), 1)[1])
    data[second : second + 8] = data[8:16]
    path.write_bytes(bytes(data))
    with pytest.raises(InputError, match="same ID"):
        read_posed_scene(tmp_path)


def test_the_order_of_records_does_not_matter(tmp_path: Path) -> None:
    write_submodel(random_scene(4), np.arange(24), np.arange(200), tmp_path)
    expected = read_posed_scene(tmp_path)
    for name, index in (("images", index_images), ("points3D", index_points)):
        path = tmp_path / f"{name}.bin"
        content = path.read_bytes()
        found = index(np.frombuffer(content[8:], dtype=np.uint8), int.from_bytes(content[:8], "little")) + 8
        starts = found.reshape(len(found), -1)[:, 0]
        records = [content[start:end] for start, end in zip(starts[:-1], starts[1:], strict=True)]
        path.write_bytes(content[:8] + b"".join(records[::-1]))
    found = read_posed_scene(tmp_path)
    _equal(found, expected)
    np.testing.assert_array_equal(found.point_ids, expected.point_ids)


def test_names_with_spaces(tmp_path: Path) -> None:
    scene = make_scene({"a b.jpg": level_camera([0, 0, 0], 0), "c.jpg": level_camera([0, 1, 0], 0)}, [[5, 0, 0]])
    write_submodel(scene, np.arange(2), np.arange(1), tmp_path)
    assert tuple(read_posed_scene(tmp_path).image_names) == ("a b.jpg", "c.jpg")


def test_no_model(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no COLMAP model"):
        read_posed_scene(tmp_path)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_cut_off_file(tmp_path: Path, name: str) -> None:
    path = _model_bytes(tmp_path) / f"{name}.bin"
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(InputError, match=f"{name}.bin"):
        read_posed_scene(tmp_path)
    path.write_bytes(b"\xff" * 100)
    with pytest.raises(InputError, match=f"{name}.bin"):
        read_posed_scene(tmp_path)


def test_pose_that_is_not_finite(tmp_path: Path) -> None:
    path = _model_bytes(tmp_path) / "images.bin"
    data = bytearray(path.read_bytes())
    data[12:20] = np.float64(np.nan).tobytes()
    path.write_bytes(bytes(data))
    with pytest.raises(InputError, match="pose of image"):
        read_posed_scene(tmp_path)


def test_point_that_is_not_finite(tmp_path: Path) -> None:
    path = _model_bytes(tmp_path) / "points3D.bin"
    data = bytearray(path.read_bytes())
    data[16:24] = np.float64(np.inf).tobytes()
    path.write_bytes(bytes(data))
    with pytest.raises(InputError, match="not finite"):
        read_posed_scene(tmp_path)


@pytest.mark.parametrize("name", ["../a.jpg", "/etc/a.jpg", "a/../../b.jpg"])
def test_names_that_leave_the_image_folder(tmp_path: Path, name: str) -> None:
    scene = make_scene({"x.jpg": level_camera([0, 0, 0], 0), name: level_camera([0, 1, 0], 0)}, [[5, 0, 0]])
    write_submodel(scene, np.arange(2), np.arange(1), tmp_path)
    with pytest.raises(InputError, match="leaves the image folder"):
        read_posed_scene(tmp_path)


def test_broken_text_model(tmp_path: Path) -> None:
    for name in ("cameras", "images", "points3D"):
        (tmp_path / f"{name}.txt").write_text("1 NOT_A_MODEL x y z\n")
    with pytest.raises(InputError, match="can't read the text model"):
        read_posed_scene(tmp_path)
