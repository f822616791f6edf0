"""The files of a COLMAP model, read in pieces into arrays, with no Python object per image or point."""

from __future__ import annotations

import struct
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from app.errors import InputError
from app.scene.kernels import (
    IMAGE_HEADER_BYTES,
    POINT_HEADER_BYTES,
    decode_tracks,
    gather_bytes,
    gather_names,
    index_images,
    index_points,
)
from app.scene.posed_scene import ImageNames, projection_centers

if TYPE_CHECKING:
    # Loaded only where a model is read: processes that select views have no use for it.
    import pycolmap

_IMAGE_HEADER = np.dtype([("id", "<u4"), ("quaternion", "<f8", 4), ("translation", "<f8", 3), ("camera", "<u4")])
_POINT_HEADER = np.dtype([("id", "<u8"), ("position", "<f8", 3), ("color", "u1", 3), ("error", "<f8")])
_CAMERA_HEADER = struct.Struct("<IiQQ")
_PIECE_BYTES = 1 << 26


@dataclass(frozen=True, kw_only=True)
class PosedImages:
    """The images and cameras of a model; see :class:`~app.scene.posed_scene.PosedScene`."""

    image_names: ImageNames
    image_ids: NDArray[np.int64]
    camera_index: NDArray[np.int32]
    cam_from_world: NDArray[np.float64]
    camera_ids: NDArray[np.int64]
    camera_params_px: NDArray[np.float64]
    camera_sizes_px: NDArray[np.int32]


@dataclass(frozen=True, kw_only=True)
class PointPiece:
    """Some of a model's points, in the order of its file; see :class:`~app.scene.posed_scene.PosedScene`."""

    point_ids: NDArray[np.int64]
    points_in_world: NDArray[np.float64]
    point_colors: NDArray[np.uint8]
    point_normals: NDArray[np.float32]
    track_lengths: NDArray[np.int64]
    track_images: NDArray[np.int32]


@contextmanager
def binary_model(model_dir: Path) -> Iterator[Path]:
    """The folder of a model, or of a binary copy of it while the context lasts if it is a text model.

    Raises:
        InputError: there is no model, or COLMAP can't read its text.
    """
    stems = ("cameras", "images", "points3D")
    if all((model_dir / f"{stem}.bin").is_file() for stem in stems):
        yield model_dir
        return
    if not all((model_dir / f"{stem}.txt").is_file() for stem in stems):
        raise InputError(f"no COLMAP model in {model_dir}: it needs cameras, images and points3D, as .bin or .txt")
    import pycolmap

    with tempfile.TemporaryDirectory() as binary_dir:
        try:
            pycolmap.Reconstruction(str(model_dir)).write_binary(binary_dir)
        except (ValueError, RuntimeError, IndexError) as error:
            reason = " ".join(str(error).split())
            raise InputError(f"COLMAP can't read the text model in {model_dir}: {reason}") from error
        yield Path(binary_dir)


def read_images(binary_dir: Path, model_dir: Path) -> PosedImages:
    """Images and cameras of a binary model. Cameras become the pinholes that COLMAP's undistortion makes of them.

    Args:
        binary_dir: Where its files are.
        model_dir: Its name in messages.

    Raises:
        InputError: cut off, poses that aren't finite, names that can't be used, images without camera.
    """
    header_pieces, name_pieces = [], []
    for data, index in _pieces(binary_dir / "images.bin", model_dir, index_images, IMAGE_HEADER_BYTES + 9):
        header_pieces.append(gather_bytes(data, index[:-1, 0], IMAGE_HEADER_BYTES).reshape(-1).view(_IMAGE_HEADER))
        name_bytes = gather_names(data, index[:-1, 0] + IMAGE_HEADER_BYTES, index[:-1, 1])
        name_pieces.append(name_bytes.reshape(-1).view(f"S{name_bytes.shape[1]}"))
    if not header_pieces:
        raise InputError(f"the model in {model_dir} has no registered image")
    headers, names = np.concatenate(header_pieces), np.concatenate(name_pieces)
    _check_names(names, model_dir)
    order = np.argsort(names, kind="stable")
    headers, names = headers[order], names[order]
    if np.any(names[1:] == names[:-1]):
        raise InputError(f"two images in {model_dir} have the same name; names must be unique")
    if len(np.unique(headers["id"])) != len(headers):
        raise InputError(f"two images in {model_dir} have the same ID; IDs must be unique")
    image_names = ImageNames(names)
    cameras = read_cameras(binary_dir, model_dir)
    camera_ids = np.array(list(cameras), dtype=np.int64)
    params, sizes = _pinholes(cameras, model_dir)
    camera_index = np.searchsorted(camera_ids, headers["camera"])
    known = camera_index < len(camera_ids)
    known[known] = camera_ids[camera_index[known]] == headers["camera"][known]
    if not known.all():
        raise InputError(f"image {image_names[int(np.argmin(known))]!r} in {model_dir} has no camera in the model")
    return PosedImages(
        image_names=image_names,
        image_ids=headers["id"].astype(np.int64),
        camera_index=camera_index.astype(np.int32),
        cam_from_world=_poses(headers, image_names, model_dir),
        camera_ids=camera_ids,
        camera_params_px=params,
        camera_sizes_px=sizes,
    )


def read_points(binary_dir: Path, model_dir: Path, images: PosedImages) -> Iterator[PointPiece]:
    """Points of a binary model with observations in at least two of its images; each image counts once.

    Raises:
        InputError: cut off, or a position that isn't finite.
    """
    centers = projection_centers(images.cam_from_world)
    order = np.argsort(images.image_ids)
    ascending_ids, rows = images.image_ids[order], order.astype(np.int32)
    # A table, unless a few great IDs would make it large.
    table_length = min(int(ascending_ids[-1]) + 1, 16 * len(order) + 1_000_000)
    row_of_id = np.full(table_length, -1, dtype=np.int32)
    in_table = ascending_ids < table_length
    row_of_id[ascending_ids[in_table]] = rows[in_table]
    for data, index in _pieces(binary_dir / "points3D.bin", model_dir, index_points, POINT_HEADER_BYTES + 8):
        headers = gather_bytes(data, index[:-1], POINT_HEADER_BYTES).reshape(-1).view(_POINT_HEADER)
        positions = np.ascontiguousarray(headers["position"])
        finite = np.isfinite(positions).all(axis=1)
        if not finite.all():
            raise InputError(
                f"point {headers['id'][int(np.argmin(finite))]} in {model_dir} has a position that is not finite"
            )
        offsets, track_images, normals = decode_tracks(data, index, positions, centers, row_of_id, ascending_ids, rows)
        lengths = np.diff(offsets)
        kept = lengths >= 2
        yield PointPiece(
            point_ids=headers["id"][kept].astype(np.int64),
            points_in_world=positions[kept],
            point_colors=headers["color"][kept],
            point_normals=normals[kept],
            track_lengths=lengths[kept],
            track_images=track_images[np.repeat(kept, lengths)],
        )


def _pieces(
    path: Path,
    model_dir: Path,
    index: Callable[[NDArray[np.uint8], int], NDArray[np.int64]],
    min_record_bytes: int,
) -> Iterator[tuple[NDArray[np.uint8], NDArray[np.int64]]]:
    """Pieces of a model file, each with the index of the records in it."""
    cut_off = InputError(f"{path.name} in {model_dir} is cut off; export the model again")
    size, piece_bytes = path.stat().st_size, _PIECE_BYTES
    with path.open("rb") as file:
        count = int.from_bytes(file.read(8), "little")
        if size < 8 or count > size // min_record_bytes:
            raise cut_off
        position = 8
        while count:
            file.seek(position)
            data = np.frombuffer(file.read(piece_bytes), dtype=np.uint8)
            found = index(data, min(count, len(data) // min_record_bytes))
            if len(found) == 1:
                if position + len(data) == size:
                    raise cut_off
                piece_bytes *= 2
                continue
            count -= len(found) - 1
            position += int(found.flat[-1])
            if position > size:
                raise cut_off
            yield data, found


def _check_names(names: NDArray[np.bytes_], model_dir: Path) -> None:
    suspicious = (names == b"") | np.strings.startswith(names, b"/") | (np.strings.find(names, b"..") >= 0)
    suspicious |= (names.view(np.uint8).reshape(len(names), -1) >= 128).any(axis=1)
    for encoded in names[suspicious].tolist():
        try:
            name = encoded.decode("utf-8")
        except UnicodeDecodeError as error:
            raise InputError(f"an image name in {model_dir} is not UTF-8; rename the image") from error
        path_in_folder = PurePosixPath(name)
        if not name or path_in_folder.is_absolute() or ".." in path_in_folder.parts:
            raise InputError(f"image name {name!r} in {model_dir} leaves the image folder; rename it in the model")


def read_cameras(binary_dir: Path, model_dir: Path) -> dict[int, pycolmap.Camera]:
    """Cameras of a binary model by ID, ascending, as they are in it.

    Raises:
        InputError: cut off, or without usable size or parameters.
    """
    import pycolmap

    path = binary_dir / "cameras.bin"
    content, position = path.read_bytes(), 8
    count = int.from_bytes(content[:8], "little")
    if len(content) < 8 or count > len(content) // _CAMERA_HEADER.size:
        raise InputError(f"{path.name} in {model_dir} is cut off; export the model again")
    cameras = {}
    for _ in range(count):
        try:
            camera_id, model_id, width, height = _CAMERA_HEADER.unpack_from(content, position)
            camera = pycolmap.Camera.create_from_model_id(
                camera_id, pycolmap.CameraModelId(model_id), 1.0, width, height
            )
            params = struct.unpack_from(f"<{len(camera.params)}d", content, position + _CAMERA_HEADER.size)
        except (struct.error, ValueError, TypeError) as error:
            raise InputError(f"{path.name} in {model_dir} is cut off or has an unknown camera model") from error
        position += _CAMERA_HEADER.size + 8 * len(params)
        camera.params = list(params)
        if width < 1 or height < 1 or not np.all(np.isfinite(params)):
            raise InputError(f"camera {camera_id} in {model_dir} has no usable size or parameters")
        cameras[camera_id] = camera
    return dict(sorted(cameras.items()))


def _pinholes(cameras: dict[int, pycolmap.Camera], model_dir: Path) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """fx, fy, cx, cy (M, 4) and sizes (M, 2) of the undistorted cameras."""
    import pycolmap

    params, sizes = [], []
    for camera_id, camera in cameras.items():
        try:
            pinhole = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
        except (ValueError, RuntimeError) as error:
            raise InputError(
                f"camera {camera_id} in {model_dir} ({camera.model_name}) can't be undistorted to a pinhole"
            ) from error
        params.append(list(pinhole.params))
        sizes.append([pinhole.width, pinhole.height])
    return np.array(params, dtype=np.float64).reshape(-1, 4), np.array(sizes, dtype=np.int32).reshape(-1, 2)


def _poses(headers: NDArray[np.void], names: ImageNames, model_dir: Path) -> NDArray[np.float64]:
    """(N, 3, 4) [R | t] from unit quaternions in COLMAP's order w, x, y, z."""
    norms = np.linalg.norm(headers["quaternion"], axis=1)
    usable = np.isfinite(norms) & (norms > 0) & np.isfinite(headers["translation"]).all(axis=1)
    if not usable.all():
        raise InputError(f"the pose of image {names[int(np.argmin(usable))]!r} in {model_dir} is not finite")
    w, x, y, z = (headers["quaternion"] / norms[:, None]).T
    pose = np.empty((len(names), 3, 4))
    pose[:, 0, :3] = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], axis=1)
    pose[:, 1, :3] = np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], axis=1)
    pose[:, 2, :3] = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)
    pose[:, :, 3] = headers["translation"]
    return pose
