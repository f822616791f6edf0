"""Cameras, sparse points and tracks as flat arrays: what clustering and selection work on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, kw_only=True)
class PosedScene:
    """A posed model, images sorted by name. N images, M cameras, P points, T track elements.

    Cameras are pinholes: the ones that undistortion makes of the model's cameras, so that what is visible here is what
    dense stereo will see.
    """

    image_names: tuple[str, ...]
    image_ids: NDArray[np.int64]
    """(N,) COLMAP's image IDs."""
    camera_index: NDArray[np.int32]
    """(N,) row in the camera arrays."""
    cam_from_world: NDArray[np.float64]
    """(N, 3, 4) [R | t]; camera x right, y down, z forward."""
    camera_ids: NDArray[np.int64]
    """(M,) COLMAP's camera IDs, ascending."""
    camera_params_px: NDArray[np.float64]
    """(M, 4) fx, fy, cx, cy; the centre of the top-left pixel is (0.5, 0.5)."""
    camera_sizes_px: NDArray[np.int32]
    """(M, 2) width, height."""
    point_ids: NDArray[np.int64]
    """(P,) COLMAP's point3D IDs, ascending."""
    points_in_world: NDArray[np.float64]
    """(P, 3)"""
    point_colors: NDArray[np.uint8]
    """(P, 3) red, green, blue."""
    track_offsets: NDArray[np.int64]
    """(P + 1,) point p is observed in ``track_images[track_offsets[p]:track_offsets[p + 1]]``."""
    track_images: NDArray[np.int32]
    """(T,) rows in the image arrays, ascending and unique within a point."""

    @property
    def image_from_world(self) -> NDArray[np.float64]:
        """(N, 3, 4) K [R | t]: homogeneous pixel coordinates (u z, v z, z) of points in the world."""
        focal, center = self.camera_params_px[self.camera_index, :2], self.camera_params_px[self.camera_index, 2:]
        depth_row = self.cam_from_world[:, 2:3]
        pixels = focal[:, :, None] * self.cam_from_world[:, :2] + center[:, :, None] * depth_row
        return np.concatenate([pixels, depth_row], axis=1)

    @property
    def image_sizes_px(self) -> NDArray[np.float64]:
        """(N, 2) width and height of each image."""
        return self.camera_sizes_px[self.camera_index].astype(np.float64)

    @property
    def centers_in_world(self) -> NDArray[np.float64]:
        """(N, 3) projection centres -R^T t."""
        rotation, translation = self.cam_from_world[:, :, :3], self.cam_from_world[:, :, 3]
        centers: NDArray[np.float64] = -np.einsum("nji,nj->ni", rotation, translation)
        return centers
