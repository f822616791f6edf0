"""An inventory in words."""

from __future__ import annotations

from collections.abc import Sequence

from app.capture.inventory import Inventory

_MAX_RANGES = 8


def describe(inventory: Inventory) -> str:
    """Several lines: cameras, frames, resolutions, what is missing in which camera, and what is known besides."""
    num_frames, num_images = len(inventory.frames), len(inventory.images)
    kind = "a rig" if inventory.is_rig else "no rig"
    lines = [
        f"{_count(len(inventory.cameras), 'camera')} ({kind}), {_count(num_frames, 'frame')}, "
        f"{_count(num_images, 'image')} in {inventory.image_root}"
    ]
    frame_names = [frame.name for frame in inventory.frames]
    for camera in inventory.cameras:
        focal = f", focal length {camera.focal_prior_px:.0f} px by EXIF" if camera.focal_prior_px else ""
        line = f"  {camera.name or '(root)'}: {camera.num_images} images of {camera.width}x{camera.height}{focal}"
        if inventory.is_rig:
            missing = [camera.name not in frame.images for frame in inventory.frames]
            names = compress_names(frame_names, missing)
            line += f"; missing {sum(missing)}: {names}" if names else "; none missing"
        lines.append(line)
    if inventory.video_frame_interval_s is not None:
        lines.append(f"  from videos, every {inventory.video_frame_interval_s:g} s where the vehicle moves")
    turned = sum(image.quarter_turns != 0 for image in inventory.images)
    if turned:
        lines.append(f"  turned by EXIF orientation: {_share(turned, num_images, 'image')}")
    with_gps = sum(frame.gps is not None for frame in inventory.frames)
    with_position = sum(frame.position_m is not None for frame in inventory.frames)
    lines.append(f"  GPS: {_share(with_gps, num_frames, 'frame')}")
    if with_position:
        lines.append(f"  known positions: {_share(with_position, num_frames, 'frame')}")
    if inventory.mask_root is not None:
        lines.append(f"  masks: {_share(sum(image.has_mask for image in inventory.images), num_images, 'image')}")
    if inventory.rig_file is not None:
        lines.append(f"  rig calibration: {inventory.rig_file}")
    return "\n".join(lines)


def compress_names(names: Sequence[str], chosen: Sequence[bool]) -> str:
    """Chosen names as ranges, `000003-000007, 000009`; a range runs over neighbours in ``names``."""
    padded = [False, *chosen, False]
    starts = [index for index in range(len(names)) if padded[index + 1] and not padded[index]]
    ends = [index for index in range(len(names)) if padded[index + 1] and not padded[index + 2]]
    shown = [
        names[start] if start == end else f"{names[start]}-{names[end]}"
        for start, end in zip(starts[:_MAX_RANGES], ends[:_MAX_RANGES], strict=True)
    ]
    rest = len(starts) - len(shown)
    return ", ".join(shown) + (f" and {rest} more" if rest else "")


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def _share(part: int, whole: int, noun: str) -> str:
    if part == whole:
        return f"all {_count(whole, noun)}"
    return f"{part} of {_count(whole, noun)}" if part else "none"
