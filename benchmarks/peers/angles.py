"""How well two images triangulate a point in [F]: Furukawa et al., Towards Internet-scale Multi-view Stereo, 2010."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# The values are those of CMVS, the authors' program.
_BEST_ANGLE_DEG = 20.0
_SPREAD_BELOW_DEG, _SPREAD_ABOVE_DEG = 5.0, 15.0
_PAIRS_AT_ONCE = 1 << 20


def angle_weights(
    points_in_world: NDArray[np.float64],
    centers_in_world: NDArray[np.float64],
    point: NDArray[np.int64],
    a: NDArray[np.int64],
    b: NDArray[np.int64],
) -> NDArray[np.float64]:
    """(Q,) Gaussian of the angle at each of (Q,) points between the images (Q,) `a` and `b`; 1 at 20 degrees."""
    weights = np.empty(len(point))
    for start in range(0, len(point), _PAIRS_AT_ONCE):
        piece = slice(start, start + _PAIRS_AT_ONCE)
        position = points_in_world[point[piece]]
        to_a, to_b = centers_in_world[a[piece]] - position, centers_in_world[b[piece]] - position
        norms = np.linalg.norm(to_a, axis=1) * np.linalg.norm(to_b, axis=1)
        angles = np.degrees(np.arccos(np.clip(np.sum(to_a * to_b, axis=1) / norms, -1.0, 1.0)))
        spread = np.where(angles < _BEST_ANGLE_DEG, _SPREAD_BELOW_DEG, _SPREAD_ABOVE_DEG)
        weights[piece] = np.exp(-((angles - _BEST_ANGLE_DEG) ** 2) / (2 * spread**2))
    return weights
