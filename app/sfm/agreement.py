"""Whether two models of the same images tell the same story."""

from __future__ import annotations

import numpy as np
import pycolmap
from numpy.typing import NDArray

from app.georegister.alignment import fit_spatial

_MIN_SHARED_IMAGES = 5
"""With fewer, nothing can be said."""
_MAX_DISTANCE = 0.05
"""Of the shared images' root mean square distance from their middle."""
_MIN_AGREEING = 0.8


def positions_agree(model: pycolmap.Reconstruction, other: pycolmap.Reconstruction) -> bool:
    """Whether a similarity brings four of five shared images to where the other model has them.

    Right models of the sets in docs/benchmarks.md differ by 2 % of their extent, wrong ones by 18 % and more. Models
    that share fewer than five images don't disagree.
    """
    positions, others = _positions(model), _positions(other)
    shared = sorted(positions.keys() & others.keys())
    if len(shared) < _MIN_SHARED_IMAGES:
        return True
    target = np.array([positions[name] for name in shared])
    extent = float(np.linalg.norm(target - target.mean(axis=0)) / np.sqrt(len(shared)))
    fit = fit_spatial(np.array([others[name] for name in shared]), target, seed=0)
    if fit is None:
        return False
    near = np.linalg.norm(fit.residuals_m, axis=1) <= _MAX_DISTANCE * extent
    return bool(near.mean() >= _MIN_AGREEING)


def _positions(model: pycolmap.Reconstruction) -> dict[str, NDArray[np.float64]]:
    images = (model.image(image_id) for image_id in model.reg_image_ids())
    return {image.name: image.projection_center() for image in images}
