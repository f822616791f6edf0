"""What was captured: cameras, frames (instants), and what belongs to each."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class CameraEntry:
    """One physical camera: the images of one folder."""

    name: str
    """Folder relative to the image root, with `/`; empty when the images lie in the root itself."""
    width: int
    height: int
    num_images: int
    focal_prior_px: float | None = None
    """From EXIF (35 mm equivalent), if there."""


@dataclass(frozen=True, kw_only=True)
class FrameEntry:
    """One instant: an image per camera that fired, and where the vehicle was if known."""

    name: str
    """File stem shared by the frame's images; the image name itself when there is no rig."""
    images: dict[str, str]
    """Camera name to image name (relative to the image root, with `/`)."""
    gps: tuple[float, float, float] | None = None
    """WGS84 latitude and longitude in degrees, ellipsoidal height in metres."""
    position_m: tuple[float, float, float] | None = None
    """Cartesian position prior (from TUM or KITTI pose files)."""


@dataclass(frozen=True, kw_only=True)
class ImageEntry:
    """One image file, checked to decode."""

    name: str
    size_bytes: int
    digest: str
    """Hash of size and first 64 KiB: tells changed images without reading them all."""


@dataclass(frozen=True, kw_only=True)
class Inventory:
    """The capture stage's product. Frames are in order of capture, images sorted by name."""

    image_root: Path
    """Absolute. The user's folder, or the workspace's `capture/frames` for videos."""
    cameras: tuple[CameraEntry, ...]
    frames: tuple[FrameEntry, ...]
    images: tuple[ImageEntry, ...]
    is_rig: bool
    """The cameras move as one rig, and each frame's images were taken at the same time."""
    rig_file: Path | None = None
    """COLMAP rig_config.json with known extrinsics, if given."""
    mask_root: Path | None = None
    """Absolute. COLMAP's naming: `mask_root/NAME.png`."""
    video_frame_interval_s: float | None = None

    def write(self, path: Path) -> None:
        """Write as JSON."""
        path.write_text(json.dumps(asdict(self), indent=1, default=str) + "\n", encoding="utf-8")

    @classmethod
    def read(cls, path: Path) -> Inventory:
        """Read what `write` wrote."""
        data = json.loads(path.read_text(encoding="utf-8"))
        return cls(
            image_root=Path(data["image_root"]),
            cameras=tuple(CameraEntry(**camera) for camera in data["cameras"]),
            frames=tuple(
                FrameEntry(
                    name=frame["name"],
                    images=frame["images"],
                    gps=tuple(frame["gps"]) if frame["gps"] else None,
                    position_m=tuple(frame["position_m"]) if frame["position_m"] else None,
                )
                for frame in data["frames"]
            ),
            images=tuple(ImageEntry(**image) for image in data["images"]),
            is_rig=data["is_rig"],
            rig_file=Path(data["rig_file"]) if data["rig_file"] else None,
            mask_root=Path(data["mask_root"]) if data["mask_root"] else None,
            video_frame_interval_s=data["video_frame_interval_s"],
        )
