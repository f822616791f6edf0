"""A map of all clusters, like figure 2 of [O]."""

from __future__ import annotations

import colorsys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from app.clustering.clusters import Clustering
from app.errors import CityReconError
from app.scene.posed_scene import PosedScene

Image = NDArray[np.uint8]

_LONGER_SIDE_PX = 1600
_BORDER_PX = 20
_KEYPOINT_BGR = (150, 110, 60)
_CAMERA_BGR = (40, 40, 200)
_SMALL_BGR = (0, 0, 0)


def write_map(scene: PosedScene, clustering: Clustering, path: Path) -> None:
    """Draw the clusters' cells, each cluster in a colour of its own, with the keypoints and the cameras' path.

    North (y) is up. Clusters that stayed too small have a black cross in each cell.

    Args:
        scene: What was clustered.
        clustering: With at least one cluster.
        path: PNG to write.
    """
    grid = clustering.grid
    size = np.array(grid.block_size_m)
    cells = np.array([cell for cluster in clustering.clusters for cell in cluster.cells])
    centers = scene.centers_in_world[:, :2]
    low = cells.min(axis=0) * size + grid.origin_m
    high = (cells.max(axis=0) + 1) * size + grid.origin_m
    px_per_unit = _LONGER_SIDE_PX / float((high - low).max())

    def to_pixels(positions: NDArray[np.float64]) -> NDArray[np.int64]:
        x = (positions[:, 0] - low[0]) * px_per_unit + _BORDER_PX
        y = (high[1] - positions[:, 1]) * px_per_unit + _BORDER_PX
        return np.round(np.stack([x, y], axis=1)).astype(np.int64)

    width, height = np.ceil((high - low) * px_per_unit).astype(int) + 2 * _BORDER_PX
    image = np.full((height, width, 3), 255, dtype=np.uint8)
    for number, cluster in enumerate(clustering.clusters):
        color = tuple(round(255 * c) for c in colorsys.hsv_to_rgb((number * 0.618034) % 1, 0.35, 0.95))
        for cell in cluster.cells:
            corner = np.array(cell) * size + grid.origin_m
            (x0, y1), (x1, y0) = to_pixels(np.stack([corner, corner + size])).tolist()
            cv2.rectangle(image, (x0, y0), (x1, y1), color, -1)
            cv2.rectangle(image, (x0, y0), (x1, y1), (190, 190, 190), 1)
            if cluster.is_small:
                cv2.drawMarker(image, ((x0 + x1) // 2, (y0 + y1) // 2), _SMALL_BGR, cv2.MARKER_TILTED_CROSS, 12, 2)
    _draw_dots(image, to_pixels(_inside(scene.points_in_world[:, :2], low, high)), 1, _KEYPOINT_BGR)
    _draw_dots(image, to_pixels(_inside(centers, low, high)), 3, _CAMERA_BGR)
    ok, encoded = cv2.imencode(".png", image)
    if not ok:
        raise CityReconError(f"cannot encode {path}")
    path.write_bytes(encoded.tobytes())


def _inside(positions: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64]:
    return positions[np.all((positions >= low) & (positions <= high), axis=1)]


def _draw_dots(image: Image, pixels: NDArray[np.int64], side: int, color: tuple[int, int, int]) -> None:
    """Paint squares; positions lie inside the image's border."""
    for dx in range(-(side // 2), side // 2 + 1):
        for dy in range(-(side // 2), side // 2 + 1):
            image[pixels[:, 1] + dy, pixels[:, 0] + dx] = color
