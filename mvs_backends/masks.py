"""Masks of a dense job."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from mvs_backends.base import MvsError, MvsJob


def read_mask(job: MvsJob, view: int, width: int, height: int) -> NDArray[np.bool_] | None:
    """(height, width) true where depth is wanted; None without masks or for a view without one.

    Raises:
        MvsError: it can't be read.
    """
    if job.mask_dir is None:
        return None
    path = job.mask_dir / f"{job.views[view].name}.png"
    if not path.exists():
        return None
    mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if mask is None:
        raise MvsError(f"cannot read mask {path}; remove or replace it")
    # Nothing wanted is lost and nothing masked is kept at a coarse level: the last level decides.
    return np.asarray(cv2.resize(mask, (width, height), interpolation=cv2.INTER_NEAREST)) > 0
