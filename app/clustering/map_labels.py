"""What maps of the ground say, whatever draws them."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class MapLabels:
    """What the axes of the world are called."""

    unit: str = "m"
    """Of lengths."""
    up: str = "N"
    """Where y points."""


def round_length(length: float) -> float:
    """The greatest of 1, 2 and 5 times a power of ten that isn't longer, for a scale bar."""
    power = 10.0 ** math.floor(math.log10(length))
    return power * max(factor for factor in (1, 2, 5) if factor * power <= length * (1 + 1e-9))
