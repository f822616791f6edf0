"""Compiled loops over COLMAP's binary records, and the test whether an image sees a point."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

IMAGE_HEADER_BYTES = 64
"""images.bin: u32 image ID, 4 f64 quaternion (w, x, y, z), 3 f64 translation, u32 camera ID; then the name."""
POINT_HEADER_BYTES = 43
"""points3D.bin: u64 point ID, 3 f64 position, 3 u8 colour, f64 error; then u64 track length."""
POINT2D_BYTES = 24
TRACK_ELEMENT_BYTES = 8


@njit(cache=True)
def _u64(data: NDArray[np.uint8], start: int) -> np.uint64:
    value = np.uint64(0)
    for byte in range(8):
        value |= np.uint64(data[start + byte]) << np.uint64(8 * byte)
    return value


@njit(cache=True)
def index_images(data: NDArray[np.uint8], count: int) -> NDArray[np.int64]:
    """Find the records of an images.bin without reading the 2D points in them.

    Args:
        data: (bytes,) the file.
        count: Records that its first 8 bytes promise.

    Returns:
        (count + 1, 2) start of each record and end of its name (the NUL); the last row's first entry is where the last
        record ends. Empty when the file is cut off.
    """
    index = np.empty((count + 1, 2), np.int64)
    position = 8
    for record in range(count):
        index[record, 0] = position
        position += IMAGE_HEADER_BYTES
        while position < len(data) and data[position] != 0:
            position += 1
        if position + 9 > len(data):
            return np.empty((0, 2), np.int64)
        index[record, 1] = position
        num_points2D = _u64(data, position + 1)
        position += 9
        if num_points2D > np.uint64((len(data) - position) // POINT2D_BYTES):
            return np.empty((0, 2), np.int64)
        position += int(num_points2D) * POINT2D_BYTES
    index[count, 0] = position
    index[count, 1] = position
    return index


@njit(cache=True)
def index_points(data: NDArray[np.uint8], count: int) -> NDArray[np.int64]:
    """Find the records of a points3D.bin.

    Args:
        data: (bytes,) the file.
        count: Records that its first 8 bytes promise.

    Returns:
        (count + 1,) start of each record, and the end of the last one. Empty when the file is cut off.
    """
    index = np.empty(count + 1, np.int64)
    position = 8
    for record in range(count):
        index[record] = position
        position += POINT_HEADER_BYTES
        if position + 8 > len(data):
            return np.empty(0, np.int64)
        length = _u64(data, position)
        position += 8
        if length > np.uint64((len(data) - position) // TRACK_ELEMENT_BYTES):
            return np.empty(0, np.int64)
        position += int(length) * TRACK_ELEMENT_BYTES
    index[count] = position
    return index


@njit(cache=True)
def gather_bytes(data: NDArray[np.uint8], starts: NDArray[np.int64], width: int) -> NDArray[np.uint8]:
    """(len(starts), width) the ``width`` bytes of ``data`` after each start."""
    out = np.empty((len(starts), width), np.uint8)
    for row in range(len(starts)):
        for byte in range(width):
            out[row, byte] = data[starts[row] + byte]
    return out


@njit(cache=True)
def gather_track_image_ids(
    data: NDArray[np.uint8], index: NDArray[np.int64], offsets: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Image IDs of all tracks of a points3D.bin.

    Args:
        data: (bytes,) the file.
        index: (P + 1,) from :func:`index_points`.
        offsets: (P + 1,) where each point's track starts in the output.

    Returns:
        (T,) image IDs.
    """
    out = np.empty(offsets[-1], np.int64)
    for point in range(len(index) - 1):
        position = index[point] + POINT_HEADER_BYTES + 8
        for element in range(offsets[point], offsets[point + 1]):
            out[element] = (
                np.int64(data[position])
                | np.int64(data[position + 1]) << 8
                | np.int64(data[position + 2]) << 16
                | np.int64(data[position + 3]) << 24
            )
            position += TRACK_ELEMENT_BYTES
    return out


@njit(cache=True)
def sees(image_from_world: NDArray[np.float64], size_px: NDArray[np.float64], point: NDArray[np.float64]) -> bool:
    """Whether a point lies in front of a pinhole image and projects into its rectangle.

    Args:
        image_from_world: (3, 4) K [R | t].
        size_px: (2,) width, height.
        point: (3,) in the world.
    """
    m = image_from_world
    z = m[2, 0] * point[0] + m[2, 1] * point[1] + m[2, 2] * point[2] + m[2, 3]
    u = m[0, 0] * point[0] + m[0, 1] * point[1] + m[0, 2] * point[2] + m[0, 3]
    v = m[1, 0] * point[0] + m[1, 1] * point[1] + m[1, 2] * point[2] + m[1, 3]
    return bool((z > 0.0) & (u >= 0.0) & (u < size_px[0] * z) & (v >= 0.0) & (v < size_px[1] * z))
