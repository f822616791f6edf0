"""The capture stage: take stock of what the user gave, and refuse at once what can't be used."""

from __future__ import annotations

import logging
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import pycolmap

from app.capture.gps import GpsTable, assign_gps, mean_position, read_gps_file
from app.capture.image_check import ImageProbe, check_images, image_digest, png_size
from app.capture.inventory import CameraEntry, FrameEntry, ImageEntry, Inventory
from app.capture.options import CaptureOptions, RigMode
from app.capture.poses import PoseFile, match_poses, read_pose_file
from app.capture.rig import check_prefixes, read_rig_file
from app.capture.scan import VIDEO_SUFFIXES, Listing, camera_of, check_stems, natural_key, scan, stem_of
from app.capture.video import Sampling, extract_frames, frame_rate_of, times_along_path
from app.errors import CityReconError, InputError

logger = logging.getLogger(__name__)

_MIN_SHARED_FRAMES = 0.5


def capture(
    source: Path,
    output: Path,
    *,
    options: CaptureOptions,
    gps_file: Path | None = None,
    pose_file: Path | None = None,
    rig_file: Path | None = None,
    mask_dir: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Inventory:
    """Check the images and write `output/inventory.json`, and for videos `output/frames/CAMERA/NUMBER.jpg`.

    Args:
        source: a folder of images, a folder of camera folders (the same file name is the same instant), a video, or
            a folder with one video per camera.
        output: the stage's folder; may be renamed afterwards (see `Inventory.image_root`).
        options: options.
        gps_file: see `read_gps_file`; takes the place of EXIF positions.
        pose_file: see `read_pose_file`; camera positions as priors.
        rig_file: COLMAP's rig_config.json with known extrinsics.
        mask_dir: masks in COLMAP's naming, `MASK_DIR/IMAGE_NAME.png`.
        progress: called with steps done and total.

    Returns:
        The inventory, with paths inside ``output`` as they are now.

    Raises:
        InputError: the source or one of the files can't be used.
        CityReconError: the result can't be written.
    """
    source = _existing(source, "image folder or video")
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot write {output}: {error.strerror}; choose another workspace") from error
    # Small files first: their errors shouldn't wait for all images to be decoded.
    gps = read_gps_file(gps_file) if gps_file is not None else None
    poses = read_pose_file(pose_file) if pose_file is not None else None
    rigs = read_rig_file(rig_file) if rig_file is not None else None
    times_s: dict[str, float] = {}
    interval_s: float | None = None
    root = source
    listing = _list(source, output, mask_dir)
    if not listing.images:
        root = output.absolute() / "frames"
        times_s, interval_s = _frames_from_videos(source, listing.videos, root, gps, options, progress)
        listing = scan(root.resolve())
    elif listing.videos:
        logger.warning("%s: %d video(s) beside the images are not used", source, len(listing.videos))
    names = listing.images
    if len(names) < 2:
        raise InputError(f"{source} gives only {len(names)} image; at least two that overlap are needed")
    check_stems(source, names)
    if rig_file is not None and rigs is not None:
        check_prefixes(rig_file, rigs, names)
    checked = check_images(root, names, num_threads=options.num_threads, progress=progress)
    probes = dict(zip(names, checked, strict=True))
    cameras = _cameras(source, root, probes)
    is_rig = _is_rig([camera.name for camera in cameras], names, options.rig_mode, rig_file)
    frames = _with_positions(_frames(probes, is_rig, times_s), gps, poses)
    masks = _check_masks(mask_dir, probes) if mask_dir else {}
    inventory = Inventory(
        image_root=root,
        cameras=cameras,
        frames=frames,
        images=_images(probes, masks),
        is_rig=is_rig,
        rig_file=rig_file.resolve() if rig_file else None,
        mask_root=mask_dir.resolve() if mask_dir else None,
        video_frame_interval_s=interval_s,
    )
    try:
        inventory.write(output / "inventory.json")
    except OSError as error:
        raise CityReconError(f"cannot write {output / 'inventory.json'}: {error.strerror}; free some space") from error
    return inventory


def _images(probes: Mapping[str, ImageProbe], masks: Mapping[str, str]) -> tuple[ImageEntry, ...]:
    return tuple(
        ImageEntry(
            name=name,
            size_bytes=probe.size_bytes,
            digest=probe.digest,
            mask_digest=masks.get(name, ""),
            quarter_turns=probe.quarter_turns,
        )
        for name, probe in sorted(probes.items())
    )


def _existing(path: Path, what: str) -> Path:
    try:
        return path.resolve(strict=True)
    except OSError as error:
        raise InputError(f"{what} {path} can't be opened: {error.strerror}; check the path") from error
    except RuntimeError as error:
        raise InputError(f"{what} {path} is a link to itself; check the path") from error


def _list(source: Path, output: Path, mask_dir: Path | None) -> Listing:
    if source.is_file():
        if source.suffix.lower() not in VIDEO_SUFFIXES:
            raise InputError(f"{source} is neither a folder nor a video; give a folder of images, or a video")
        return Listing(images=(), videos=(source.name,))
    workspace = output.resolve().parent
    if workspace == source:
        raise InputError(f"workspace {workspace} is the image folder itself; choose another with --workspace")
    if mask_dir is not None and _existing(mask_dir, "mask folder") == source:
        raise InputError(f"mask folder {mask_dir} is the image folder itself; keep masks in a folder of their own")
    exclude = [workspace] if mask_dir is None else [workspace, mask_dir.resolve()]
    listing = scan(source, exclude=exclude)
    if not listing.images and not listing.videos:
        raise InputError(f"no images in {source}; give a folder with jpg, png, tif, bmp or webp images, or a video")
    return listing


def _videos_by_camera(source: Path, names: Sequence[str]) -> dict[str, Path]:
    """Camera name to video: the folder's name for the only video of a folder below the source, else the stem."""
    if source.is_file():
        return {"cam0": source}
    per_folder = Counter(camera_of(name) for name in names)
    crowded = next((folder for folder, number in per_folder.items() if folder and number > 1), None)
    if crowded is not None:
        raise InputError(f"{source / crowded} holds {per_folder[crowded]} videos of one camera; join them into one")
    cameras = {camera_of(name) or stem_of(name): source / name for name in names}
    if len(cameras) < len(names):
        raise InputError(f"{source}: two videos have the same name but for the suffix; rename one of them")
    return cameras


def _frames_from_videos(
    source: Path,
    names: Sequence[str],
    output: Path,
    gps: GpsTable | None,
    options: CaptureOptions,
    progress: Callable[[int, int], None] | None,
) -> tuple[dict[str, float], float | None]:
    """Write the frames; returns their times by name and the time between those looked at, if it was constant."""
    videos = _videos_by_camera(source, names)
    sampling = _sampling(videos, gps, options)
    extracted = extract_frames(videos, output, sampling, progress=progress)
    logger.info(
        "%d frames from %d video(s), %d left out because the vehicle stood still",
        len(extracted.times_s),
        len(videos),
        extracted.num_still,
    )
    return extracted.times_s, sampling.interval_s if sampling.times_s is None else None


def _sampling(videos: Mapping[str, Path], gps: GpsTable | None, options: CaptureOptions) -> Sampling:
    times = None
    if options.video_spacing_m is not None:
        if gps is None:
            logger.warning(
                "no GPS file, so video frames are taken every %g s and not every %g m",
                options.video_interval_s,
                options.video_spacing_m,
            )
        else:
            rate = frame_rate_of(next(iter(videos.values())))
            times = times_along_path(gps, options.video_spacing_m, rate)
    return Sampling(
        interval_s=options.video_interval_s,
        times_s=times,
        min_displacement=options.video_min_displacement,
        jpeg_quality=options.video_jpeg_quality,
    )


def _cameras(source: Path, root: Path, probes: Mapping[str, ImageProbe]) -> tuple[CameraEntry, ...]:
    by_camera: dict[str, list[str]] = defaultdict(list)
    for name in probes:
        by_camera[camera_of(name)].append(name)
    cameras = []
    for camera in sorted(by_camera, key=natural_key):
        names = by_camera[camera]
        sizes = Counter((probes[name].width, probes[name].height) for name in names)
        (width, height), _ = sizes.most_common(1)[0]
        if len(sizes) > 1:
            rows = ", ".join(f"{w}x{h} ({number})" for (w, h), number in sizes.most_common(3))
            odd = next(name for name in names if (probes[name].width, probes[name].height) != (width, height))
            raise InputError(
                f"{source / camera} mixes images of different sizes: {rows}; first other one {odd}; "
                "put each size into a folder of its own"
            )
        first = next((name for name in names if probes[name].has_exif), None)
        focal = None
        if first is not None:
            bitmap = pycolmap.Bitmap.read(root / first, False)
            focal = bitmap.exif_focal_length() if bitmap is not None else None
        cameras.append(
            CameraEntry(name=camera, width=width, height=height, num_images=len(names), focal_prior_px=focal)
        )
    return tuple(cameras)


def _is_rig(cameras: Sequence[str], names: Sequence[str], mode: RigMode, rig_file: Path | None) -> bool:
    if mode is not RigMode.AUTO:
        return mode is RigMode.YES
    if len(cameras) < 2:
        return False
    if rig_file is not None:
        return True
    holders = Counter(stem_of(name) for name in names)
    smallest = min(Counter(camera_of(name) for name in names).values())
    return sum(number > 1 for number in holders.values()) >= _MIN_SHARED_FRAMES * smallest


def _frames(probes: Mapping[str, ImageProbe], is_rig: bool, times_s: Mapping[str, float]) -> tuple[FrameEntry, ...]:
    images: dict[str, dict[str, str]] = defaultdict(dict)
    for name in probes:
        images[stem_of(name) if is_rig else name][camera_of(name)] = name
    frames = []
    for frame in sorted(images, key=natural_key):
        gps = [position for name in images[frame].values() if (position := probes[name].gps) is not None]
        frames.append(
            FrameEntry(
                name=frame,
                images=images[frame],
                gps=mean_position(gps) if gps else None,
                time_s=times_s.get(stem_of(frame) if not is_rig else frame),
            )
        )
    return tuple(frames)


def _with_positions(
    frames: tuple[FrameEntry, ...], gps: GpsTable | None, poses: PoseFile | None
) -> tuple[FrameEntry, ...]:
    if gps is not None:
        positions = assign_gps(frames, gps)
        frames = tuple(replace(frame, gps=positions.get(frame.name)) for frame in frames)
        missing = len(frames) - len(positions)
        if missing:
            logger.warning("%s has no position for %d of %d frames", gps.path, missing, len(frames))
    if poses is not None:
        by_image = match_poses(poses, frames)
        found = []
        for frame in frames:
            pose = next((by_image[image] for image in frame.images.values() if image in by_image), None)
            position = None if pose is None else (float(pose[0, 3]), float(pose[1, 3]), float(pose[2, 3]))
            found.append(replace(frame, position_m=position))
        frames = tuple(found)
    return frames


def _check_masks(mask_dir: Path, probes: Mapping[str, ImageProbe]) -> dict[str, str]:
    """Hash of the mask of each image that has one, by the image's name."""
    found = {}
    for name, probe in probes.items():
        path = mask_dir / f"{name}.png"
        try:
            data = path.read_bytes()
        except FileNotFoundError:
            continue
        except OSError as error:
            raise InputError(f"cannot read mask {path}: {error.strerror}; check its permissions") from error
        size = png_size(data)
        if size != (probe.width, probe.height):
            what = "is no PNG file" if size is None else f"has {size[0]}x{size[1]} pixels"
            raise InputError(f"mask {path} {what}; its image has {probe.width}x{probe.height}; correct or remove it")
        found[name] = image_digest(data)
    first = next(iter(probes))
    if not found:
        raise InputError(f"no image has a mask in {mask_dir}; the mask of {first} must be {mask_dir / first}.png")
    if len(found) < len(probes):
        logger.warning("%d of %d images have no mask in %s", len(probes) - len(found), len(probes), mask_dir)
    return found
