"""Options of the georegister stage."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class GeoregisterOptions:
    """Options of the georegister stage."""

    scale: float | None = None
    """Metres per unit of the model, if known; goes before all other sources of scale."""
    camera_height_m: float | None = None
    """Height of the cameras over the road. Taken to be right to 5 %: GPS and rig go before it where they are better."""
    z_is_up: bool = False
    """The model's z axis points up already (an imported model, or known poses in a levelled frame): don't tilt it, and
    without GPS don't turn or move it either."""
    seed: int = 0
    """Of the random sampling in robust estimates."""

    def __post_init__(self) -> None:
        for name in ("scale", "camera_height_m"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < math.inf:
                raise ValueError(f"{name} must be above 0, not {value}")
        if self.seed < 0:
            raise ValueError(f"seed must be at least 0, not {self.seed}")
