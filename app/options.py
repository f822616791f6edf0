"""Options of the stages that have no package of their own."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class DensifyOptions:
    """Which back-end makes the depth maps, and at what size."""

    backend: str = "auto"
    """Dense back-end; `cityrecon doctor` lists those that can run here. auto: colmap if its CUDA works, else
    patchmatch."""
    max_image_size_px: int = 1600
    """Longer side of the undistorted images that stereo works on; larger images are reduced. 0: no limit."""
    skip_sky: bool = True
    """Find the sky in each image (smooth, bright, up to the image's upper border) and give it no depth."""

    def __post_init__(self) -> None:
        if self.max_image_size_px < 0:
            raise ValueError(f"max_image_size_px must be at least 0, not {self.max_image_size_px}")
