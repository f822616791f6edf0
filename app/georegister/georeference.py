"""What is known about a model's frame: where it lies on Earth, which way is up, and how long a metre is."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from pathlib import Path

from app.errors import InputError


class ScaleSource(StrEnum):
    """Where the scale comes from."""

    GPS = "gps"
    RIG = "rig"
    """Known distances between the rig's cameras."""
    CAMERA_HEIGHT = "camera_height"
    OPTION = "option"
    POSES = "poses"
    """A pose file's positions."""
    NONE = "none"


class GravitySource(StrEnum):
    """Where the up direction comes from, most decisive first."""

    GPS = "gps"
    GPS_AND_CAMERAS = "gps+cameras"
    """Each of both has a part of more than a tenth; the ground plane counts with the cameras."""
    CAMERAS_AND_GROUND = "cameras+ground"
    CAMERAS = "cameras"
    MODEL = "model"
    """The model's z axis was declared to be up."""
    NONE = "none"


@dataclass(frozen=True, kw_only=True)
class ScaleCandidate:
    """One way to the scale."""

    source: ScaleSource
    metres_per_model_unit: float
    relative_sigma: float
    """Estimated standard deviation of the scale, divided by the scale."""


@dataclass(frozen=True, kw_only=True)
class Residuals:
    """Distances between GPS (or known positions) and the model's positions, over the frames that fit. Metres."""

    num_frames: int
    """Frames with a position and a registered image."""
    num_inliers: int
    horizontal_rms_m: float
    horizontal_median_m: float
    horizontal_max_m: float
    vertical_rms_m: float | None
    """None when the source gives no heights."""
    vertical_median_m: float | None
    vertical_max_m: float | None
    antenna_m: tuple[float, float] | None = None
    """The antenna's place right of and in front of the reference camera, where the data tell; residuals are to it."""


@dataclass(frozen=True, kw_only=True)
class Georeference:
    """The georegister stage's findings. The world is right-handed, with z up to within `gravity_sigma_deg`."""

    crs: str
    """`local`, or `ENU at origin (EPSG:4979)`: x east, y north, z up, metres, tangent to the WGS84 ellipsoid."""
    origin_deg_m: tuple[float, float, float] | None
    """WGS84 latitude, longitude (degrees) and height (metres, as the GPS source gives it; 0 if it gives none) of the
    world's origin; None without GPS."""
    is_metric: bool
    """The world's unit is one metre. If not, it is the median distance between consecutive frames."""
    scale_source: ScaleSource
    gravity_source: GravitySource
    gravity_sigma_deg: float
    """Estimated standard deviation of the up direction about its least certain axis."""
    scale_candidates: tuple[ScaleCandidate, ...] = ()
    """All that was available, the one used first."""
    world_from_model: tuple[float, ...] = field(default=(1.0, 0.0, 0.0, 0.0) * 3)
    """The similarity that was applied: 3 x 4 matrix [scale * R | t], row by row."""
    camera_height: float | None = None
    """Median height of the cameras over the ground plane in world units; None if no ground was found."""
    residuals: Residuals | None = None
    outlier_frames: tuple[str, ...] = ()
    """Frames whose GPS doesn't fit (the first 100)."""

    def write(self, path: Path) -> None:
        """Write as JSON with full double precision."""
        path.write_text(json.dumps(asdict(self), indent=1, allow_nan=False) + "\n", encoding="utf-8")

    @classmethod
    def read(cls, path: Path) -> Georeference:
        """Read what `write` wrote.

        Raises:
            InputError: the file is missing or isn't a georeference.
        """
        try:
            data = json.loads(path.read_text(encoding="utf-8"))
            data["scale_source"] = ScaleSource(data["scale_source"])
            data["gravity_source"] = GravitySource(data["gravity_source"])
            data["origin_deg_m"] = tuple(data["origin_deg_m"]) if data["origin_deg_m"] else None
            data["world_from_model"] = tuple(data["world_from_model"])
            data["outlier_frames"] = tuple(data["outlier_frames"])
            residuals = data["residuals"]
            if residuals:
                residuals["antenna_m"] = tuple(residuals["antenna_m"]) if residuals["antenna_m"] else None
            data["residuals"] = Residuals(**residuals) if residuals else None
            data["scale_candidates"] = tuple(
                ScaleCandidate(**{**candidate, "source": ScaleSource(candidate["source"])})
                for candidate in data["scale_candidates"]
            )
            return cls(**data)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(
                f"cannot read the georeference {path}: {error}; run the georegister stage again"
            ) from error
