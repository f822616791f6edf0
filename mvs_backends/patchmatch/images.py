"""Grey images of a job at the sizes of the pyramid, a bounded number of bytes of them kept."""

from __future__ import annotations

from collections import OrderedDict

import cv2
import numpy as np
from numpy.typing import NDArray

from mvs_backends.base import MvsError, MvsJob
from mvs_backends.patchmatch.cost.kernels import pack_neighbours
from mvs_backends.patchmatch.geometry import level_size


class ImageCache:
    """Grey images and their packed form, the least recently used ones let go."""

    def __init__(self, job: MvsJob, max_bytes: int = 1_000_000_000) -> None:
        self._job = job
        self._max_bytes = max_bytes
        self._kept: OrderedDict[tuple[int, int], tuple[NDArray[np.uint8], NDArray[np.uint32]]] = OrderedDict()

    def get(self, view: int, level: int) -> tuple[NDArray[np.uint8], NDArray[np.uint32]]:
        """(H, W) grey values and (H * W,) packed 2 x 2 neighbourhoods of a view halved `level` times.

        Raises:
            MvsError: the image can't be read, or has not the view's size.
        """
        key = (view, level)
        if key in self._kept:
            self._kept.move_to_end(key)
            return self._kept[key]
        grey = self._read(view)
        if level > 0:
            size = level_size(self._job.views[view], level)
            grey = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint8)
        packed = np.empty(grey.size, np.uint32)
        pack_neighbours(grey, packed)
        self._kept[key] = (grey, packed)
        while len(self._kept) > 1 and sum(a.nbytes + b.nbytes for a, b in self._kept.values()) > self._max_bytes:
            self._kept.popitem(last=False)
        return grey, packed

    def _read(self, view: int) -> NDArray[np.uint8]:
        path = self._job.image_path(view)
        # IMREAD_IGNORE_ORIENTATION: the cameras belong to the pixels as stored.
        grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
        expected = self._job.views[view]
        if grey is None:
            raise MvsError(f"cannot read image {path}; run densify again from the undistortion on")
        if grey.shape != (expected.height, expected.width):
            raise MvsError(
                f"image {path} is {grey.shape[1]}x{grey.shape[0]}, its camera {expected.width}x{expected.height}; "
                "run densify again from the undistortion on"
            )
        return np.ascontiguousarray(grey, dtype=np.uint8)
