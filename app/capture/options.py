"""Options of the capture stage."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class RigMode(StrEnum):
    """Whether images of the same name in different folders were taken at the same instant."""

    AUTO = "auto"
    """Yes if at least half of the smaller folder's names are in another folder too."""
    YES = "yes"
    NO = "no"


@dataclass(frozen=True, kw_only=True)
class CaptureOptions:
    """Options of the capture stage."""

    rig_mode: RigMode = RigMode.AUTO
    """Whether the cameras move as one rig."""
    video_interval_s: float = 0.25
    """Seconds between video frames: 2 m at 30 km/h."""
    video_spacing_m: float | None = None
    """Metres between video frames, if there is a GPS file; takes the place of the interval."""
    video_min_displacement: float = 0.0025
    """A video frame is kept when the image has moved by this share of its width (median over tracked corners) since
    the last frame kept; less is standing still. Measured: 0.4 to 2 % per metre for cameras that look ahead, 1 to 4 %
    to the side, and under 0.1 % by noise alone. 0 keeps all."""
    video_jpeg_quality: int = 95
    """Of the frames written, 1 to 100."""
    num_threads: int = 0
    """Threads that decode images; 0 for one per core."""

    def __post_init__(self) -> None:
        if not 0.0 < self.video_interval_s < float("inf"):
            raise ValueError(f"video_interval_s must be above 0, not {self.video_interval_s}")
        if self.video_spacing_m is not None and not 0.01 <= self.video_spacing_m < float("inf"):
            raise ValueError(f"video_spacing_m must be at least 0.01, not {self.video_spacing_m}")
        if not 0.0 <= self.video_min_displacement < 1.0:
            raise ValueError(
                f"video_min_displacement must be at least 0 and below 1, not {self.video_min_displacement}"
            )
        if not 1 <= self.video_jpeg_quality <= 100:
            raise ValueError(f"video_jpeg_quality must be from 1 to 100, not {self.video_jpeg_quality}")
        if self.num_threads < 0:
            raise ValueError(f"num_threads must be at least 0, not {self.num_threads}")
