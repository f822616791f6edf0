"""COLMAP model, binary or text -> :class:`PosedScene`, with no Python object per point."""

from __future__ import annotations

import struct
import tempfile
from pathlib import Path, PurePosixPath

import numpy as np
import pycolmap
from numpy.typing import NDArray

from app.errors import InputError
from app.scene.kernels import (
    IMAGE_HEADER_BYTES,
    POINT_HEADER_BYTES,
    TRACK_ELEMENT_BYTES,
    gather_bytes,
    gather_track_image_ids,
    index_images,
    index_points,
)
from app.scene.posed_scene import PosedScene

_IMAGE_HEADER = np.dtype([("id", "<u4"), ("quaternion", "<f8", 4), ("translation", "<f8", 3), ("camera", "<u4")])
_POINT_HEADER = np.dtype([("id", "<u8"), ("position", "<f8", 3), ("color", "u1", 3), ("error", "<f8")])
_CAMERA_HEADER = struct.Struct("<IiQQ")


def read_posed_scene(model_dir: Path) -> PosedScene:
    """Read a COLMAP model as arrays.

    Cameras become the pinholes that COLMAP's undistortion makes of them. A point counts once per image, and only with
    observations in at least two registered images. The result doesn't depend on the order of records in the model.

    Args:
        model_dir: Folder with ``cameras``, ``images`` and ``points3D``, all ``.bin`` or all ``.txt``.

    Raises:
        InputError: the model is absent, cut off, holds poses or points that aren't finite, or unusable names.
    """
    stems = ("cameras", "images", "points3D")
    if all((model_dir / f"{stem}.bin").is_file() for stem in stems):
        return _read_binary(model_dir, model_dir)
    if not all((model_dir / f"{stem}.txt").is_file() for stem in stems):
        raise InputError(f"no COLMAP model in {model_dir}: it needs cameras, images and points3D, as .bin or .txt")
    with tempfile.TemporaryDirectory() as binary_dir:
        try:
            pycolmap.Reconstruction(str(model_dir)).write_binary(binary_dir)
        except (ValueError, RuntimeError, IndexError) as error:
            reason = " ".join(str(error).split())
            raise InputError(f"COLMAP can't read the text model in {model_dir}: {reason}") from error
        return _read_binary(Path(binary_dir), model_dir)


def _read_binary(binary_dir: Path, model_dir: Path) -> PosedScene:
    headers, names = _read_images(binary_dir / "images.bin", model_dir)
    camera_ids, params, sizes = _read_cameras(binary_dir / "cameras.bin", model_dir)
    order = np.array(sorted(range(len(names)), key=names.__getitem__), dtype=np.int64)
    headers, sorted_names = headers[order], tuple(names[row] for row in order)
    camera_index = np.searchsorted(camera_ids, headers["camera"])
    known = camera_index < len(camera_ids)
    known[known] = camera_ids[camera_index[known]] == headers["camera"][known]
    if not known.all():
        raise InputError(f"image {sorted_names[int(np.argmin(known))]!r} in {model_dir} has no camera in the model")
    image_ids = headers["id"].astype(np.int64)
    points, offsets, track_images = _read_points(binary_dir / "points3D.bin", model_dir, image_ids)
    return PosedScene(
        image_names=sorted_names,
        image_ids=image_ids,
        camera_index=camera_index.astype(np.int32),
        cam_from_world=_poses(headers, sorted_names, model_dir),
        camera_ids=camera_ids,
        camera_params_px=params,
        camera_sizes_px=sizes,
        point_ids=points["id"].astype(np.int64),
        points_in_world=np.ascontiguousarray(points["position"]),
        point_colors=np.ascontiguousarray(points["color"]),
        track_offsets=offsets,
        track_images=track_images,
    )


def _bytes_and_count(path: Path, model_dir: Path, min_record_bytes: int) -> tuple[NDArray[np.uint8], int]:
    """Map a model file and read the number of records it promises."""
    if path.stat().st_size < 8:
        raise InputError(f"{path.name} in {model_dir} is cut off; export the model again")
    data = np.asarray(np.memmap(path, dtype=np.uint8, mode="r"))
    count = int(data[:8].view("<u8")[0])
    if count > len(data) // min_record_bytes:
        raise InputError(f"{path.name} in {model_dir} is cut off; export the model again")
    return data, count


def _read_images(path: Path, model_dir: Path) -> tuple[NDArray[np.void], list[str]]:
    data, count = _bytes_and_count(path, model_dir, IMAGE_HEADER_BYTES + 9)
    index = index_images(data, count)
    if len(index) == 0:
        raise InputError(f"{path.name} in {model_dir} is cut off; export the model again")
    if count == 0:
        raise InputError(f"the model in {model_dir} has no registered image")
    names = []
    for start, end in index[:-1] + (IMAGE_HEADER_BYTES, 0):
        try:
            name = data[start:end].tobytes().decode("utf-8")
        except UnicodeDecodeError as error:
            raise InputError(f"an image name in {model_dir} is not UTF-8; rename the image") from error
        path_in_folder = PurePosixPath(name)
        if not name or path_in_folder.is_absolute() or ".." in path_in_folder.parts:
            raise InputError(f"image name {name!r} in {model_dir} leaves the image folder; rename it in the model")
        names.append(name)
    if len(set(names)) != len(names):
        raise InputError(f"two images in {model_dir} have the same name; names must be unique")
    headers = gather_bytes(data, index[:-1, 0], IMAGE_HEADER_BYTES).reshape(-1).view(_IMAGE_HEADER)
    if len(np.unique(headers["id"])) != count:
        raise InputError(f"two images in {model_dir} have the same ID; IDs must be unique")
    return headers, names


def _read_cameras(path: Path, model_dir: Path) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int32]]:
    """Ascending IDs (M,), and fx, fy, cx, cy (M, 4) and sizes (M, 2) of the undistorted pinholes."""
    data, count = _bytes_and_count(path, model_dir, _CAMERA_HEADER.size)
    content, position = data.tobytes(), 8
    pinholes: dict[int, tuple[list[float], list[int]]] = {}
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
        try:
            pinhole = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
        except (ValueError, RuntimeError) as error:
            raise InputError(
                f"camera {camera_id} in {model_dir} ({camera.model_name}) can't be undistorted to a pinhole"
            ) from error
        pinholes[camera_id] = (list(pinhole.params), [pinhole.width, pinhole.height])
    ids = sorted(pinholes)
    return (
        np.array(ids, dtype=np.int64),
        np.array([pinholes[i][0] for i in ids], dtype=np.float64).reshape(-1, 4),
        np.array([pinholes[i][1] for i in ids], dtype=np.int32).reshape(-1, 2),
    )


def _poses(headers: NDArray[np.void], names: tuple[str, ...], model_dir: Path) -> NDArray[np.float64]:
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


def _read_points(
    path: Path, model_dir: Path, image_ids: NDArray[np.int64]
) -> tuple[NDArray[np.void], NDArray[np.int64], NDArray[np.int32]]:
    """Headers of the points kept, ascending by ID, and their tracks as offsets and rows of images."""
    data, count = _bytes_and_count(path, model_dir, POINT_HEADER_BYTES + 8)
    index = index_points(data, count)
    if len(index) == 0:
        raise InputError(f"{path.name} in {model_dir} is cut off; export the model again")
    headers = gather_bytes(data, index[:-1], POINT_HEADER_BYTES).reshape(-1).view(_POINT_HEADER)
    finite = np.isfinite(headers["position"]).all(axis=1)
    if not finite.all():
        raise InputError(
            f"point {headers['id'][int(np.argmin(finite))]} in {model_dir} has a position that is not finite"
        )
    if len(np.unique(headers["id"])) != count:
        raise InputError(f"two points in {model_dir} have the same ID; IDs must be unique")

    lengths = (np.diff(index) - POINT_HEADER_BYTES - 8) // TRACK_ELEMENT_BYTES
    offsets = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
    observed_ids = gather_track_image_ids(data, index, offsets)
    rows_by_id = np.argsort(image_ids)
    slot = np.minimum(np.searchsorted(image_ids[rows_by_id], observed_ids), len(image_ids) - 1)
    image_rows = rows_by_id[slot]
    registered = image_ids[image_rows] == observed_ids

    rank = np.empty(count, dtype=np.int64)
    order = np.argsort(headers["id"])
    rank[order] = np.arange(count)
    pairs = np.unique(np.repeat(rank, lengths)[registered] * len(image_ids) + image_rows[registered])
    point_of_pair = pairs // len(image_ids)
    num_images = np.bincount(point_of_pair, minlength=count)
    kept = num_images >= 2
    kept_offsets = np.concatenate([[0], np.cumsum(num_images[kept])]).astype(np.int64)
    track_images = (pairs % len(image_ids))[kept[point_of_pair]].astype(np.int32)
    return headers[order][kept], kept_offsets, track_images
