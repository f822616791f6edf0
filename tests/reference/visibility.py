"""Slow plain twins of the kernels of clustering and view selection."""

from __future__ import annotations

import itertools
import struct

import numpy as np


def sees(image_from_world: np.ndarray, size_px: np.ndarray, point: np.ndarray) -> bool:
    """Project a point and look whether it is in front and inside the image."""
    x, y, z = image_from_world @ np.append(point, 1.0)
    return bool(z > 0 and 0 <= x / z < size_px[0] and 0 <= y / z < size_px[1])


def cameras_with_a_view(points: np.ndarray, image_from_world: np.ndarray, sizes_px: np.ndarray) -> list[bool]:
    """Per camera, whether it sees any of the points."""
    found = []
    for matrix, size_px in zip(image_from_world, sizes_px, strict=True):
        x, y, z = matrix[:, :3] @ points.T + matrix[:, 3:]
        front = z > 0
        u, v = x[front] / z[front], y[front] / z[front]
        found.append(bool(np.any((u >= 0) & (u < size_px[0]) & (v >= 0) & (v < size_px[1]))))
    return found


def visibility_matrix(points: np.ndarray, image_from_world: np.ndarray, sizes_px: np.ndarray) -> np.ndarray:
    """(P, N) which image sees which point."""
    rows = [[sees(m, s, p) for m, s in zip(image_from_world, sizes_px, strict=True)] for p in points]
    return np.array(rows, dtype=bool).reshape(len(points), len(image_from_world))


def share_at_least(sets: list[set[int]], min_shared: int) -> np.ndarray:
    """(N, N) which different sets have that many common members."""
    return np.array([[a is not b and len(a & b) >= min_shared for b in sets] for a in sets], dtype=bool)


def undominated(rows: list[set[int]], bounds: list[int]) -> list[bool]:
    """Which rows no other remaining row implies; the first of equals remains."""
    keep = [True] * len(rows)
    for row, other in itertools.product(range(len(rows)), repeat=2):
        if row != other and keep[other] and rows[other] <= rows[row] and bounds[other] >= bounds[row]:
            same = rows[other] == rows[row] and bounds[other] == bounds[row]
            if not same or other < row:
                keep[row] = False
    return keep


def mean_directions(points: np.ndarray, tracks: list[list[int]], centers: np.ndarray) -> np.ndarray:
    """(P, 3) unit vectors along the mean direction from each point to the images in its track."""
    directions = np.zeros((len(points), 3))
    for point, track in enumerate(tracks):
        towards = [centers[image] - points[point] for image in track]
        mean = np.sum([t / np.linalg.norm(t) for t in towards if t.any()], axis=0)
        if np.any(mean):
            directions[point] = mean / np.linalg.norm(mean)
    return directions.astype(np.float32)


def resolution_on_surface(
    seen: np.ndarray, points: np.ndarray, normals: np.ndarray, centers: np.ndarray, focal_lengths_px: np.ndarray
) -> tuple[np.ndarray, list[float]]:
    """Sum of relative resolutions per image, and the distances of all that is seen."""
    total, distances = np.zeros(len(centers)), []
    for views, point, normal in zip(seen, points, normals, strict=True):
        resolution = np.zeros(len(centers))
        for view in np.flatnonzero(views):
            towards = centers[view] - point
            distance = float(np.linalg.norm(towards))
            distances.append(distance)
            resolution[view] = focal_lengths_px[view] * max(0.0, normal @ towards / distance) / distance
        if resolution.max() > 0:
            total += resolution / resolution.max()
    return total, distances


def image_records(data: bytes) -> list[tuple[int, str]]:
    """Image ID and name of each record of an images.bin."""
    (count,), position, records = struct.unpack_from("<Q", data), 8, []
    for _ in range(count):
        image_id = struct.unpack_from("<I", data, position)[0]
        end = data.index(b"\0", position + 64)
        records.append((image_id, data[position + 64 : end].decode()))
        position = end + 9 + 24 * struct.unpack_from("<Q", data, end + 1)[0]
    return records


def point_records(data: bytes) -> list[tuple[int, list[int]]]:
    """Point ID and image IDs of the track of each record of a points3D.bin."""
    (count,), position, records = struct.unpack_from("<Q", data), 8, []
    for _ in range(count):
        point_id, length = struct.unpack_from("<Q35xQ", data, position)
        elements = struct.unpack_from(f"<{2 * length}I", data, position + 51)
        records.append((point_id, list(elements[::2])))
        position += 51 + 8 * length
    return records
