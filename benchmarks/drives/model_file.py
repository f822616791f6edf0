"""COLMAP's binary model, written district by district."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pycolmap
from numpy.typing import NDArray

from benchmarks.drives.kernels import scatter_bytes
from benchmarks.drives.keypoints import Keypoints
from benchmarks.drives.vehicle import CAMERAS, IMAGE_SIZE_PX, Keyframes, focal_lengths_px

_IMAGE_HEADER = np.dtype([("id", "<u4"), ("quaternion", "<f8", 4), ("translation", "<f8", 3), ("camera", "<u4")])
_POINT_2D = np.dtype([("pixel", "<f8", 2), ("point3D_id", "<u8")])
_POINT_HEADER = np.dtype(
    [("id", "<u8"), ("position", "<f8", 3), ("color", "u1", 3), ("error", "<f8"), ("length", "<u8")]
)
_TRACK_ELEMENT = np.dtype([("image_id", "<u4"), ("index", "<u4")])
_NO_POINT = np.uint64(2**64 - 1)
_UNMATCHED_SHARE = 0.15
"""2D points without a 3D point, relative to those with one. Real images have more; they only cost space."""


class ModelWriter:
    """Appends districts to a model; memory follows one district.

    Images are numbered from 1 in the order of time, cameras from 1 to 7. Image names are
    ``CAMERA/DISTRICT_FRAME.jpg``, the frame being that of the 30 Hz video.
    """

    def __init__(self, folder: Path) -> None:
        """Start the files in a folder, which is made if need be."""
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "cameras.bin").write_bytes(_cameras())
        self._images = _start(folder / "images.bin")
        self._points = _start(folder / "points3D.bin")
        self._num_images = self._num_points = self._num_districts = 0

    def add(
        self,
        keyframes: Keyframes,
        keypoints: Keypoints,
        world_from_district: NDArray[np.float64],
        rng: np.random.Generator,
    ) -> None:
        """Append a district.

        Args:
            keyframes: F.
            keypoints: P.
            world_from_district: (3, 4) rigid.
            rng: Of colours and of 2D points without a 3D point.
        """
        images, pixels = keypoints.track_images, keypoints.track_pixels
        num_images = keyframes.cam_from_district.shape[0] * len(CAMERAS)
        matched = np.bincount(images, minlength=num_images)
        unmatched = rng.poisson(_UNMATCHED_SHARE * matched.mean(), num_images)
        # 2D points of an image: the matched ones in the order of their points, then the others.
        starts = np.concatenate([[0], np.cumsum(matched + unmatched)])
        by_image = np.argsort(images, kind="stable")
        index = np.empty(len(images), dtype=np.int64)
        index[by_image] = np.arange(len(images)) - np.repeat(np.cumsum(matched) - matched, matched)
        points_2d = np.empty(starts[-1], dtype=_POINT_2D)
        points_2d["pixel"] = rng.uniform((0.0, 0.0), IMAGE_SIZE_PX, (len(points_2d), 2))
        points_2d["point3D_id"] = _NO_POINT
        point_ids = self._num_points + 1 + np.arange(len(keypoints.points))
        points_2d["pixel"][starts[images] + index] = pixels
        points_2d["point3D_id"][starts[images] + index] = np.repeat(point_ids, keypoints.track_lengths)

        self._images.write(self._image_records(keyframes, world_from_district, points_2d, starts))
        self._points.write(_point_records(keypoints, point_ids, index, self._num_images, world_from_district, rng))
        self._num_images += num_images
        self._num_points += len(keypoints.points)
        self._num_districts += 1

    def close(self) -> None:
        """Write the numbers of records."""
        for file, count in ((self._images, self._num_images), (self._points, self._num_points)):
            file.seek(0)
            file.write(struct.pack("<Q", count))
            file.close()

    def _image_records(
        self,
        keyframes: Keyframes,
        world_from_district: NDArray[np.float64],
        points_2d: NDArray[np.void],
        starts: NDArray[np.int64],
    ) -> memoryview:
        poses = keyframes.cam_from_district.reshape(-1, 3, 4)
        rotations = poses[:, :, :3] @ world_from_district[:, :3].T
        headers = np.zeros(len(poses), dtype=_IMAGE_HEADER)
        headers["id"] = self._num_images + 1 + np.arange(len(poses))
        headers["quaternion"] = _quaternions(rotations)
        headers["translation"] = poses[:, :, 3] - np.einsum("nij,j->ni", rotations, world_from_district[:, 3])
        headers["camera"] = np.tile(np.arange(len(CAMERAS)) + 1, len(keyframes.frame_numbers))
        names = [
            f"{camera}/{self._num_districts:03d}_{frame:06d}.jpg\0".encode()
            for frame in keyframes.frame_numbers.tolist()
            for camera in CAMERAS
        ]
        name_lengths = np.array([len(name) for name in names])
        counts = np.diff(starts)
        sizes = _IMAGE_HEADER.itemsize + name_lengths + 8 + _POINT_2D.itemsize * counts
        record = np.concatenate([[0], np.cumsum(sizes)])
        out = np.empty(record[-1], dtype=np.uint8)
        scatter_bytes(_rows(headers), record[:-1], out)
        after_name = record[:-1] + _IMAGE_HEADER.itemsize + name_lengths
        for name, end in zip(names, after_name.tolist(), strict=True):
            out[end - len(name) : end] = np.frombuffer(name, dtype=np.uint8)
        scatter_bytes(_rows(counts.astype("<u8")), after_name, out)
        first = after_name + 8
        places = np.repeat(first - _POINT_2D.itemsize * starts[:-1], counts)
        scatter_bytes(_rows(points_2d), places + _POINT_2D.itemsize * np.arange(len(points_2d)), out)
        return out.data


def _point_records(
    keypoints: Keypoints,
    point_ids: NDArray[np.int64],
    index: NDArray[np.int64],
    first_image: int,
    world_from_district: NDArray[np.float64],
    rng: np.random.Generator,
) -> memoryview:
    lengths = keypoints.track_lengths
    headers = np.empty(len(point_ids), dtype=_POINT_HEADER)
    headers["id"] = point_ids
    headers["position"] = keypoints.points @ world_from_district[:, :3].T + world_from_district[:, 3]
    headers["color"] = rng.integers(0, 256, (len(point_ids), 1))
    headers["error"] = rng.uniform(0.2, 1.0, len(point_ids))
    headers["length"] = lengths
    elements = np.empty(len(index), dtype=_TRACK_ELEMENT)
    elements["image_id"] = first_image + 1 + keypoints.track_images
    elements["index"] = index
    record = np.concatenate([[0], np.cumsum(_POINT_HEADER.itemsize + _TRACK_ELEMENT.itemsize * lengths)])
    out = np.empty(record[-1], dtype=np.uint8)
    scatter_bytes(_rows(headers), record[:-1], out)
    element_number = np.arange(len(elements))
    first = record[:-1] + _POINT_HEADER.itemsize - _TRACK_ELEMENT.itemsize * (np.cumsum(lengths) - lengths)
    scatter_bytes(_rows(elements), np.repeat(first, lengths) + _TRACK_ELEMENT.itemsize * element_number, out)
    return out.data


def _start(path: Path) -> BinaryIO:
    file = path.open("wb")
    file.write(bytes(8))
    return file


def _rows(records: NDArray[np.generic]) -> NDArray[np.uint8]:
    """(n, bytes) of (n,) records."""
    return np.ascontiguousarray(records).view(np.uint8).reshape(len(records), records.dtype.itemsize)


def _cameras() -> bytes:
    width, height = IMAGE_SIZE_PX
    records = [
        struct.pack("<IiQQ4d", number, int(pycolmap.CameraModelId.PINHOLE), width, height, f, f, width / 2, height / 2)
        for number, f in enumerate(focal_lengths_px().tolist(), start=1)
    ]
    return struct.pack("<Q", len(records)) + b"".join(records)


def _quaternions(rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 4) w, x, y, z of (n, 3, 3) rotations: the eigenvector of Bar-Itzhack, 2000."""
    r = rotations.transpose(1, 2, 0)
    k = np.zeros((len(rotations), 4, 4))
    k[:, 0, 0] = r[0, 0] + r[1, 1] + r[2, 2]
    k[:, 0, 1:] = np.stack([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]], axis=1)
    k[:, 1:, 1:] = rotations + rotations.transpose(0, 2, 1)
    for axis in range(3):
        k[:, axis + 1, axis + 1] -= k[:, 0, 0]
    return np.linalg.eigh(k, UPLO="U")[1][:, :, 3]
