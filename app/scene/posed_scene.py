"""Cameras, sparse points and tracks as flat arrays: what clustering and selection work on."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import overload

import numpy as np
from numpy.typing import NDArray


class ImageNames(Sequence[str]):
    """Distinct image names in ascending order, kept as one array of UTF-8 bytes: no object per name."""

    def __init__(self, encoded: NDArray[np.bytes_]) -> None:
        """Take (N,) ascending names; UTF-8 sorts as its characters do."""
        self.encoded = encoded

    @classmethod
    def of(cls, names: Iterable[str]) -> ImageNames:
        """Ascending names."""
        return cls(np.array([name.encode() for name in names], dtype=np.bytes_))

    def take(self, rows: NDArray[np.integer]) -> tuple[str, ...]:
        """The names of some rows."""
        return tuple(ImageNames(self.encoded[rows]))

    def rows_of(self, names: Sequence[str]) -> NDArray[np.int64]:
        """(n,) row of each name; -1 where there is no such image."""
        if not names or not len(self):
            return np.full(len(names), -1, dtype=np.int64)
        wanted = ImageNames.of(names).encoded
        rows = np.searchsorted(self.encoded, wanted)
        found = self.encoded[np.minimum(rows, len(self) - 1)] == wanted
        return np.where(found, rows, -1).astype(np.int64)

    def __len__(self) -> int:
        return len(self.encoded)

    @overload
    def __getitem__(self, row: int) -> str: ...
    @overload
    def __getitem__(self, row: slice) -> ImageNames: ...
    def __getitem__(self, row: int | slice) -> str | ImageNames:
        if isinstance(row, slice):
            return ImageNames(self.encoded[row])
        return str(self.encoded[row].decode())

    def __iter__(self) -> Iterator[str]:
        return iter(b"\0".join(self.encoded.tolist()).decode().split("\0") if len(self) else ())

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sequence) and tuple(self) == tuple(other)

    __hash__ = None  # type: ignore[assignment]


@dataclass(frozen=True, kw_only=True)
class PosedScene:
    """A posed model, images sorted by name. N images, M cameras, P points, T track elements.

    Cameras are pinholes: the ones that undistortion makes of the model's cameras, so that what is visible here is what
    dense stereo will see. The arrays may lie in files that are mapped into memory.
    """

    image_names: ImageNames
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
    """(P,) COLMAP's point3D IDs."""
    points_in_world: NDArray[np.float64]
    """(P, 3)"""
    point_colors: NDArray[np.uint8]
    """(P, 3) red, green, blue."""
    point_normals: NDArray[np.float32]
    """(P, 3) unit vector along the mean direction to the images that observe a point: where its surface faces, as in
    Mur-Artal et al., ORB-SLAM, 2015, section III.C."""
    track_offsets: NDArray[np.int64]
    """(P + 1,) point p is observed in ``track_images[track_offsets[p]:track_offsets[p + 1]]``."""
    track_images: NDArray[np.int32]
    """(T,) rows in the image arrays, ascending and unique within a point."""

    def observations(self, point_rows: NDArray[np.integer]) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        """(T,) place in ``point_rows`` and (T,) row of the image of each track element of some points."""
        starts = self.track_offsets[point_rows]
        lengths = self.track_offsets[point_rows + 1] - starts
        elements = np.repeat(starts - np.cumsum(lengths) + lengths, lengths) + np.arange(lengths.sum())
        return np.repeat(np.arange(len(point_rows)), lengths), self.track_images[elements]

    @property
    def image_from_world(self) -> NDArray[np.float64]:
        """(N, 3, 4) K [R | t]: homogeneous pixel coordinates (u z, v z, z) of points in the world."""
        focal, center = self.camera_params_px[self.camera_index, :2], self.camera_params_px[self.camera_index, 2:]
        depth_row = self.cam_from_world[:, 2:3]
        pixel_rows = focal[:, :, None] * self.cam_from_world[:, :2] + center[:, :, None] * depth_row
        return np.concatenate([pixel_rows, depth_row], axis=1)

    @property
    def image_sizes_px(self) -> NDArray[np.float64]:
        """(N, 2) width and height of each image."""
        return self.camera_sizes_px[self.camera_index].astype(np.float64)

    @property
    def centers_in_world(self) -> NDArray[np.float64]:
        """(N, 3) projection centres -R^T t."""
        return projection_centers(self.cam_from_world)


def projection_centers(cam_from_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 3) projection centres -R^T t of (N, 3, 4) [R | t]."""
    centers: NDArray[np.float64] = -np.einsum("nji,nj->ni", cam_from_world[:, :, :3], cam_from_world[:, :, 3])
    return centers
