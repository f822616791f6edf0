"""Maps of one view made better by those of the others."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from functools import partial

import numpy as np
from numpy.typing import NDArray

from mvs_backends.patchmatch.geometry import LevelCamera, warp
from mvs_backends.patchmatch.maps.kernels import add_agreeing_rows

_ROWS_PER_TASK = 32


def averaged_planes(
    plane: NDArray[np.float32],
    camera: LevelCamera,
    others: Sequence[tuple[LevelCamera, Callable[[], NDArray[np.float32]]]],
    executor: Executor,
) -> NDArray[np.float32]:
    """Each pixel's plane, moved to the weighted mean of its own inverse depth and those of the other views that agree.

    The errors of views are nearly independent, so their mean is more accurate than each; the nearer view counts more.

    Args:
        plane: (H, W, 3) inverse depth and its slopes along x and y; 0 where there is none.
        camera: of the view.
        others: cameras of other views, and what loads their planes; one is held at a time.
        executor: runs bands of rows.

    Returns:
        (H, W, 3), a new array.
    """
    sums = np.stack([np.ones_like(plane[..., 0]), plane[..., 0]], axis=-1)
    bands = range(0, len(plane), _ROWS_PER_TASK)
    for other, load in others:
        add = partial(add_agreeing_rows, plane=plane, source=load(), warp=warp(other, camera), sums=sums)
        for _ in executor.map(add, bands, (first + _ROWS_PER_TASK for first in bands)):
            pass
    scale = sums[..., 1] / (sums[..., 0] * np.where(plane[..., 0] > 0, plane[..., 0], 1))
    return plane * scale[..., None]
