"""Grey images of a job at the sizes of the pyramid, a bounded number of bytes of them kept."""

from __future__ import annotations

from collections import OrderedDict
from threading import Lock

import cv2
import numpy as np
from numpy.typing import NDArray

from mvs_backends.base import MvsError, MvsJob
from mvs_backends.patchmatch.cost.kernels import pack_neighbours
from mvs_backends.patchmatch.geometry import level_size

_MAX_BYTES = 1_000_000_000


def kept_bytes(num_views: int, image_px: int) -> int:
    """What an `ImageCache` comes to hold of so many views of so many pixels, at all sizes."""
    return min(_MAX_BYTES, num_views * image_px * 5 * 4 // 3)


class ImageCache:
    """Grey images and their packed form, the least recently used ones let go. Threads may share it."""

    def __init__(self, job: MvsJob, max_bytes: int = _MAX_BYTES) -> None:
        self._job = job
        self._max_bytes = max_bytes
        self._lock = Lock()
        self._kept: OrderedDict[tuple[int, int], tuple[NDArray[np.uint8], NDArray[np.uint32]]] = OrderedDict()

    def get(self, view: int, level: int) -> tuple[NDArray[np.uint8], NDArray[np.uint32]]:
        """(H, W) grey values and (H * W,) packed 2 x 2 neighbourhoods of a view halved `level` times.

        Raises:
            MvsError: the image can't be read, or has not the view's size.
        """
        key = (view, level)
        with self._lock:
            if key not in self._kept:
                self._kept[key] = self._made(view, level)
            self._kept.move_to_end(key)
            while len(self._kept) > 1 and sum(a.nbytes + b.nbytes for a, b in self._kept.values()) > self._max_bytes:
                self._kept.popitem(last=False)
            return self._kept[key]

    def _made(self, view: int, level: int) -> tuple[NDArray[np.uint8], NDArray[np.uint32]]:
        grey = self._read(view)
        if level > 0:
            size = level_size(self._job.views[view], level)
            grey = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint8)
        packed = np.empty(grey.size, np.uint32)
        pack_neighbours(grey, packed)
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
