"""What was captured: cameras, frames (instants), and what belongs to each."""

from __future__ import annotations

import json
import math
import os
from dataclasses import dataclass
from pathlib import Path

from app.errors import InputError


@dataclass(frozen=True, kw_only=True)
class CameraEntry:
    """One physical camera: the images of one folder."""

    name: str
    """Folder relative to the image root, with `/`; empty when the images lie in the root itself."""
    width: int
    height: int
    num_images: int
    focal_prior_px: float | None = None
    """From EXIF (35 mm equivalent or COLMAP's list of sensors), if there."""


@dataclass(frozen=True, kw_only=True)
class FrameEntry:
    """One instant: an image per camera that fired, and where the vehicle was if known."""

    name: str
    """File stem shared by the frame's images; the image name itself when there is no rig."""
    images: dict[str, str]
    """Camera name to image name (relative to the image root, with `/`)."""
    gps: tuple[float, float, float] | None = None
    """WGS84 latitude and longitude in degrees, height in metres (NaN when the source gives none)."""
    position_m: tuple[float, float, float] | None = None
    """Cartesian position prior (from a pose file)."""
    time_s: float | None = None
    """Seconds since the start of the video."""


@dataclass(frozen=True, kw_only=True)
class ImageEntry:
    """One image file, checked to decode."""

    name: str
    size_bytes: int
    digest: str
    """Hash of the file."""
    mask_digest: str = ""
    """Hash of the mask `mask_root/NAME.png`; empty when there is none."""
    quarter_turns: int = 0
    """Clockwise, to show it upright (EXIF orientation). Pixels are used as stored; this says where up is in them."""

    @property
    def has_mask(self) -> bool:
        """Whether parts of the image are to be ignored."""
        return self.mask_digest != ""


@dataclass(frozen=True, kw_only=True)
class Inventory:
    """The capture stage's product. Frames are in order of capture, images sorted by name."""

    image_root: Path
    """Absolute. The user's folder, or `frames` beside the inventory for videos.

    In the JSON file a root inside the inventory's folder is stored relative to it, so that the folder may be renamed;
    `read` makes it absolute again.
    """
    cameras: tuple[CameraEntry, ...]
    """In natural order of names."""
    frames: tuple[FrameEntry, ...]
    images: tuple[ImageEntry, ...]
    is_rig: bool
    """The cameras move as one rig, and each frame's images were taken at the same time."""
    rig_file: Path | None = None
    """Absolute. COLMAP rig_config.json with known extrinsics, if given."""
    mask_root: Path | None = None
    """Absolute. COLMAP's naming: `mask_root/NAME.png`."""
    video_frame_interval_s: float | None = None
    """Time between frames that were looked at, when they come from videos sampled by time."""

    def write(self, path: Path) -> None:
        """Write as JSON."""
        data = vars(self) | {
            "cameras": [vars(camera) for camera in self.cameras],
            "frames": [vars(frame) | {"gps": _gps_to_json(frame.gps)} for frame in self.frames],
            "images": [vars(image) for image in self.images],
        }
        if self.image_root.is_relative_to(path.parent.absolute()):
            data["image_root"] = self.image_root.relative_to(path.parent.absolute())
        path.write_text(json.dumps(data, indent=1, default=str, allow_nan=False) + "\n", encoding="utf-8")

    @classmethod
    def read(cls, path: Path) -> Inventory:
        """Read what `write` wrote.

        Raises:
            InputError: the file is missing or isn't an inventory.
        """
        try:
            data = json.loads(path.read_text(encoding="utf-8"))
            return cls(
                image_root=Path(os.path.normpath(path.parent.absolute() / data["image_root"])),
                cameras=tuple(CameraEntry(**camera) for camera in data["cameras"]),
                frames=tuple(
                    FrameEntry(
                        name=frame["name"],
                        images=frame["images"],
                        gps=_gps_from_json(frame["gps"]),
                        position_m=tuple(frame["position_m"]) if frame["position_m"] else None,
                        time_s=frame["time_s"],
                    )
                    for frame in data["frames"]
                ),
                images=tuple(ImageEntry(**image) for image in data["images"]),
                is_rig=data["is_rig"],
                rig_file=Path(data["rig_file"]) if data["rig_file"] else None,
                mask_root=Path(data["mask_root"]) if data["mask_root"] else None,
                video_frame_interval_s=data["video_frame_interval_s"],
            )
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(f"cannot read the inventory {path}: {error}; run the capture stage again") from error


def _gps_to_json(gps: tuple[float, float, float] | None) -> tuple[float | None, ...] | None:
    return gps if gps is None else tuple(None if math.isnan(value) else value for value in gps)


def _gps_from_json(gps: list[float | None] | None) -> tuple[float, float, float] | None:
    if gps is None:
        return None
    lat, lon, height = (math.nan if value is None else value for value in gps)
    return lat, lon, height
