"""Options of structure-from-motion. The defaults are measured: see docs/benchmarks.md, "Structure-from-Motion"."""

from __future__ import annotations

import os
from collections.abc import Container
from dataclasses import dataclass
from enum import StrEnum

_CAMERA_MODEL = "SIMPLE_RADIAL"


class FeatureExtractor(StrEnum):
    """Who computes SIFT features; all leave RootSIFT descriptors in the database."""

    AUTO = "auto"
    """COLMAP on a GPU that pycolmap can use, else OpenCV."""
    OPENCV = "opencv"
    """OpenCV's SIFT: a fifth of the CPU time of COLMAP's."""
    COLMAP = "colmap"
    """COLMAP's SIFT: on the GPU where pycolmap was built for it and there is one."""


class Strategy(StrEnum):
    """A way to map. Where the cameras are a rig, the best model is adjusted with it afterwards."""

    INCREMENTAL = "incremental"
    """Incremental mapping of single images, thresholds lowered for forward motion."""
    INCREMENTAL_FIXED = "incremental-fixed"
    """The same without refining distortion, for images that determine it badly."""
    GLOBAL = "global"
    """Global mapping of single images."""
    GLOBAL_RIG = "global-rig"
    """Global mapping with the rig: as given, or derived from the best model so far."""


@dataclass(frozen=True, kw_only=True)
class SfmOptions:
    """Options of `run_sfm`."""

    extractor: FeatureExtractor = FeatureExtractor.AUTO
    """Who computes the features."""
    max_num_features: int = 4096
    """Per image, the ones of largest scale or contrast."""
    max_image_size_px: int = 1600
    """Features are computed on images scaled down to this longer side; 0: no limit."""
    first_octave: int = 0
    """0: the image as it is; -1: doubled, more and finer features for about four times the CPU time."""
    camera_model: str = _CAMERA_MODEL
    """COLMAP's camera model for cameras that the rig file says nothing about."""
    camera_params: tuple[float, ...] = ()
    """COLMAP's parameters for that model, pixels, for all cameras; empty: a focal length from EXIF, or a guess."""
    refine_known_intrinsics: bool = False
    """Refine intrinsics that come from the rig file or from `camera_params`."""
    refine_known_extrinsics: bool = False
    """Refine rig extrinsics that come from the rig file; fixed, they give the model its scale."""
    sequence_window: int = 4
    """Each frame is matched with this many following frames, in all cameras."""
    sequence_quadratic_window: int = 3
    """And with the frames 2^k beyond the window, k below this number, camera by camera."""
    num_position_neighbors: int = 4
    """Each frame is matched with this many frames that are near (GPS, position priors) though taken at another time."""
    max_position_distance_m: float = 20.0
    """But with none farther away than this."""
    num_similar_images: int = 3
    """Where no positions are known, or several cameras are no rig, each image is matched with this many that look most
    alike."""
    max_exhaustive_images: int = 30
    """Sets of up to this many images are matched exhaustively."""
    min_registered_ratio: float = 0.9
    """Strategies are tried in order until this share of the images registers."""
    strategies: tuple[Strategy, ...] = tuple(Strategy)
    """What to try, in this order."""
    use_gpu: bool = True
    """Use a GPU for features and matching where pycolmap can."""
    num_threads: int = 0
    """0: all cores."""
    mapping_threads: int = 1
    """Of mapping. With more, large models take less time, but their last digits differ from run to run."""
    init_min_tri_angle_deg: float = 4.0
    """Least angle between the rays of the first two images (COLMAP: 16)."""
    min_tri_angle_deg: float = 0.5
    """Least angle between the rays that make a point (COLMAP: 1.5)."""
    seed: int = 1
    """Of all random sampling."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        for field in ("max_num_features", "max_exhaustive_images", "sequence_window"):
            if getattr(self, field) < 1:
                raise ValueError(f"{field} must be at least 1")
        for field in (
            "max_image_size_px",
            "sequence_quadratic_window",
            "num_position_neighbors",
            "num_threads",
            "seed",
        ):
            if getattr(self, field) < 0:
                raise ValueError(f"{field} must not be negative")
        if self.first_octave not in (-1, 0):
            raise ValueError("first_octave must be -1 or 0")
        if self.max_position_distance_m <= 0:
            raise ValueError("max_position_distance_m must be positive")
        if not 0 < self.min_registered_ratio <= 1:
            raise ValueError("min_registered_ratio must be above 0 and at most 1")
        if not self.strategies:
            raise ValueError("strategies must name at least one strategy")
        if self.camera_model != _CAMERA_MODEL and self.camera_model not in _camera_models():
            raise ValueError(
                f"camera_model must be one of COLMAP's, such as PINHOLE or OPENCV, not {self.camera_model}"
            )

    @property
    def threads(self) -> int:
        """Threads to use."""
        return self.num_threads or len(os.sched_getaffinity(0))


def _camera_models() -> Container[str]:
    """COLMAP's names; asked only where the default was changed, as loading pycolmap takes longer than all the rest."""
    import pycolmap

    return pycolmap.CameraModelId.__members__
