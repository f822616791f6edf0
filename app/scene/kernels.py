"""Compiled loops over COLMAP's binary records, and the tests whether images see points."""

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
_MAX_COUNT = np.uint64(1 << 40)
"""Of what a record says it holds: more is a damaged file, and would overflow."""


@njit(cache=True)
def _u64(data: NDArray[np.uint8], start: int) -> np.uint64:
    value = np.uint64(0)
    for byte in range(8):
        value |= np.uint64(data[start + byte]) << np.uint64(8 * byte)
    return value


@njit(cache=True)
def index_images(data: NDArray[np.uint8], count: int) -> NDArray[np.int64]:
    """Find the records of an images.bin whose headers and names lie in a piece of it, without reading their 2D points.

    Args:
        data: (bytes,) a piece of the file that begins with a record.
        count: Records to find at most.

    Returns:
        (n + 1, 2) start of each record and end of its name (the NUL); the last row holds twice where the next record
        begins, which may lie behind the piece.
    """
    index = np.empty((count + 1, 2), np.int64)
    position, found = 0, 0
    while found < count and position < len(data):
        end = position + IMAGE_HEADER_BYTES
        while end < len(data) and data[end] != 0:
            end += 1
        if end + 9 > len(data):
            break
        index[found, 0], index[found, 1] = position, end
        found += 1
        position = end + 9 + int(min(_u64(data, end + 1), _MAX_COUNT)) * POINT2D_BYTES
    index[found] = position
    return index[: found + 1]


@njit(cache=True)
def index_points(data: NDArray[np.uint8], count: int) -> NDArray[np.int64]:
    """Find the records of a points3D.bin that lie wholly in a piece of it.

    Args:
        data: (bytes,) a piece of the file that begins with a record.
        count: Records to find at most.

    Returns:
        (n + 1,) start of each record, and where the next one begins.
    """
    index = np.empty(count + 1, np.int64)
    position, found = 0, 0
    while found < count and position + POINT_HEADER_BYTES + 8 <= len(data):
        length = _u64(data, position + POINT_HEADER_BYTES)
        end = position + POINT_HEADER_BYTES + 8 + int(min(length, _MAX_COUNT)) * TRACK_ELEMENT_BYTES
        if end > len(data):
            break
        index[found] = position
        found += 1
        position = end
    index[found] = position
    return index[: found + 1]


@njit(cache=True)
def gather_bytes(data: NDArray[np.uint8], starts: NDArray[np.int64], width: int) -> NDArray[np.uint8]:
    """(len(starts), width) the ``width`` bytes of ``data`` after each start."""
    out = np.empty((len(starts), width), np.uint8)
    for row in range(len(starts)):
        for byte in range(width):
            out[row, byte] = data[starts[row] + byte]
    return out


@njit(cache=True)
def gather_names(data: NDArray[np.uint8], starts: NDArray[np.int64], ends: NDArray[np.int64]) -> NDArray[np.uint8]:
    """(len(starts), longest) the bytes from each start to its end, filled up with NULs."""
    out = np.zeros((len(starts), max(1, (ends - starts).max())), np.uint8)
    for row in range(len(starts)):
        for byte in range(ends[row] - starts[row]):
            out[row, byte] = data[starts[row] + byte]
    return out


@njit(cache=True)
def _row_of(
    image_id: int, row_of_id: NDArray[np.int32], ascending_ids: NDArray[np.int64], rows: NDArray[np.int32]
) -> int:
    if image_id < len(row_of_id):
        return int(row_of_id[image_id])
    slot = np.searchsorted(ascending_ids, image_id)
    if slot < len(ascending_ids) and ascending_ids[slot] == image_id:
        return int(rows[slot])
    return -1


@njit(cache=True)
def decode_tracks(
    data: NDArray[np.uint8],
    index: NDArray[np.int64],
    positions: NDArray[np.float64],
    centers: NDArray[np.float64],
    row_of_id: NDArray[np.int32],
    ascending_ids: NDArray[np.int64],
    rows: NDArray[np.int32],
) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.float32]]:
    """Tracks of records of a points3D.bin, each image once, and where the points face.

    Args:
        data: (bytes,) a piece of the file.
        index: (n + 1,) from :func:`index_points`.
        positions: (n, 3) of the points.
        centers: (N, 3) projection centres of the images.
        row_of_id: (L,) row of the images whose IDs are below L; -1 where there is none.
        ascending_ids: (N,) all image IDs.
        rows: (N,) their rows.

    Returns:
        (n + 1,) where each track begins in the next array, (T,) rows of images, ascending within a track, and (n, 3)
        unit vectors along the mean direction to those images; zero where there is none.
    """
    num_points = len(index) - 1
    offsets = np.zeros(num_points + 1, np.int64)
    images = np.empty((index[-1] - index[0]) // TRACK_ELEMENT_BYTES, np.int32)
    normals = np.zeros((num_points, 3), np.float32)
    direction, mean = np.empty(3), np.empty(3)
    end = 0
    for point in range(num_points):
        begin, ascends = end, True
        for position in range(index[point] + POINT_HEADER_BYTES + 8, index[point + 1], TRACK_ELEMENT_BYTES):
            image_id = (
                np.int64(data[position])
                | np.int64(data[position + 1]) << 8
                | np.int64(data[position + 2]) << 16
                | np.int64(data[position + 3]) << 24
            )
            row = _row_of(int(image_id), row_of_id, ascending_ids, rows)
            if row >= 0:
                ascends = ascends and (end == begin or images[end - 1] <= row)
                images[end] = row
                end += 1
        if not ascends:
            images[begin:end].sort()
        distinct = begin
        for element in range(begin, end):
            if element == begin or images[element] != images[distinct - 1]:
                images[distinct] = images[element]
                distinct += 1
        end = distinct
        offsets[point + 1] = end

        mean[:] = 0.0
        for element in range(begin, end):
            square = 0.0
            for axis in range(3):
                direction[axis] = centers[images[element], axis] - positions[point, axis]
                square += direction[axis] ** 2
            if square > 0.0:
                for axis in range(3):
                    mean[axis] += direction[axis] / np.sqrt(square)
        length = np.sqrt(mean[0] ** 2 + mean[1] ** 2 + mean[2] ** 2)
        if length > 0.0:
            for axis in range(3):
                normals[point, axis] = mean[axis] / length
    return offsets, images[:end], normals


@njit(cache=True)
def gather_tracks(
    offsets: NDArray[np.int64], images: NDArray[np.int32], points: NDArray[np.int64]
) -> NDArray[np.int32]:
    """(T,) the tracks of some points, one after another.

    Args:
        offsets: (P + 1,) where each point's track begins in ``images``.
        images: Rows of images.
        points: Rows of points.
    """
    total = 0
    for point in points:
        total += offsets[point + 1] - offsets[point]
    out = np.empty(total, np.int32)
    end = 0
    for point in points:
        for element in range(offsets[point], offsets[point + 1]):
            out[end] = images[element]
            end += 1
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


@njit(cache=True)
def frustum_bits(
    points: NDArray[np.float64], image_from_world: NDArray[np.float64], sizes_px: NDArray[np.float64]
) -> NDArray[np.uint64]:
    """Which points each image shows: those that `sees` says, 64 at a time.

    Args:
        points: (3, P) in the world, so that the loop over points is vectorised.
        image_from_world: (N, 3, 4) K [R | t].
        sizes_px: (N, 2) width, height.

    Returns:
        (N, ceil(P / 64)) bit ``p % 64`` of word ``p // 64`` stands for point p.
    """
    num_points = points.shape[1]
    bits = np.zeros((len(image_from_world), (num_points + 63) // 64), np.uint64)
    seen = np.zeros(64, np.uint8)
    for image in range(len(image_from_world)):
        m = image_from_world[image]
        width, height = sizes_px[image, 0], sizes_px[image, 1]
        for word in range(bits.shape[1]):
            first = 64 * word
            count = min(64, num_points - first)
            for k in range(count):
                x, y, z = points[0, first + k], points[1, first + k], points[2, first + k]
                depth = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
                u = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]
                v = m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]
                inside = (depth > 0.0) & (u >= 0.0) & (u < width * depth) & (v >= 0.0) & (v < height * depth)
                seen[k] = np.uint8(inside)
            packed = np.uint64(0)
            for k in range(count):
                packed |= np.uint64(seen[k]) << np.uint64(k)
            bits[image, word] = packed
    return bits
