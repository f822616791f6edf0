"""Frames from videos: every so many seconds or metres, and none while the vehicle stands still."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from cv2.typing import MatLike
from numpy.typing import NDArray

from app.capture.gps import GpsTable
from app.errors import CityReconError, InputError
from app.workspace import atomic_file

logger = logging.getLogger(__name__)

_SMALL_WIDTH_PX = 320
_MAX_FEATURES = 200
_MIN_TRACKED = 20
_MIN_GREY_DIFFERENCE = 4.0
_EARTH_RADIUS_M = 6_371_000.0
_MIN_FRAME_RATE, _MAX_FRAME_RATE = 0.1, 1000.0


@dataclass(frozen=True, kw_only=True)
class Sampling:
    """Which video frames to look at and which of them to keep."""

    interval_s: float
    """Time between frames, where ``times_s`` is None."""
    times_s: tuple[float, ...] | None
    """The wanted times, ascending (from positions along the path)."""
    min_displacement: float
    """A frame is kept when the image has moved by this share of its width since the last frame that was kept."""
    jpeg_quality: int


@dataclass(frozen=True, kw_only=True)
class VideoFrames:
    """The frames that were written."""

    times_s: dict[str, float]
    """Frame name to time; the name is the frame number in the first camera's video, in six digits."""
    num_still: int
    """Frames left out because the vehicle stood still."""


def extract_frames(
    videos: Mapping[str, Path],
    output: Path,
    sampling: Sampling,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> VideoFrames:
    """Write `output/CAMERA/NUMBER.jpg`; the videos are taken to start at the same instant.

    All videos run side by side, so memory is one frame per camera. Files that an interrupted run left are kept.

    Args:
        videos: camera name (a relative folder) to video.
        output: folder for the frames.
        sampling: times and thresholds.
        progress: called with frames of the first video read and their number (an estimate).

    Raises:
        InputError: a video can't be opened, or ends before its second frame.
        CityReconError: a frame can't be written.
    """
    streams = [_Stream(path) for path in videos.values()]
    folders = [output / camera for camera in videos]
    times: dict[str, float] = {}
    still = 0
    latest = -1
    try:
        for folder in folders:
            _make_folder(folder)
        motion = [_MotionGate(sampling.min_displacement) for _ in streams]
        for time in _sample_times(sampling):
            images = [stream.frame_at(time) for stream in streams]
            if any(image is None for image in images):
                break
            if streams[0].index == latest:
                continue
            latest = streams[0].index
            pictures = [image for image in images if image is not None]
            moved = [gate.moved(image) for gate, image in zip(motion, pictures, strict=True)]
            if progress:
                progress(min(streams[0].index, streams[0].num_frames), streams[0].num_frames)
            # A bus that passes one camera isn't motion of the vehicle.
            if 2 * sum(moved) < len(moved):
                still += 1
                continue
            name = f"{streams[0].index:06d}"
            for gate, image, folder in zip(motion, pictures, folders, strict=True):
                gate.keep()
                _write_jpeg(folder / f"{name}.jpg", image, sampling.jpeg_quality)
            times[name] = streams[0].time_s
    finally:
        for stream in streams:
            stream.close()
    _remove_stale(folders, {f"{name}.jpg" for name in times})
    return VideoFrames(times_s=times, num_still=still)


def times_along_path(table: GpsTable, spacing_m: float, frame_rate: float) -> tuple[float, ...]:
    """Times at which the vehicle has gone another ``spacing_m`` since the time before.

    Args:
        table: positions by time, or by frame number of the first video.
        spacing_m: wanted distance.
        frame_rate: of the first video, for positions by frame number.

    Raises:
        InputError: the positions have neither times nor frame numbers.
    """
    if table.times_s is not None:
        times = table.times_s
        positions = table.positions
    elif all(key.isdecimal() for key in table.keys):
        numbers = np.array([int(key) for key in table.keys], dtype=np.int64)
        order = np.argsort(numbers, kind="stable")
        times = numbers[order] / frame_rate
        positions = table.positions[order]
    else:
        raise InputError(f"{table.path}: frames every so many metres need positions by time_s or frame number")
    lat, lon = np.radians(positions[:, 0]), np.unwrap(np.radians(positions[:, 1]))
    east_m = (lon - lon[0]) * np.cos(lat) * _EARTH_RADIUS_M
    north_m = (lat - lat[0]) * _EARTH_RADIUS_M
    track = np.column_stack((east_m, north_m))
    wanted = [float(times[0])]
    last = track[0]
    for row in range(1, len(times)):
        start, step = track[row - 1], track[row] - track[row - 1]
        # Distance from the last wanted point, not along the track, which the wandering fixes of a standing receiver
        # make long.
        done = 0.0
        while np.linalg.norm(track[row] - last) >= spacing_m:
            done = max(_crossing(start - last, step, spacing_m), done)
            last = start + done * step
            wanted.append(float(times[row - 1] + done * (times[row] - times[row - 1])))
    return tuple(wanted)


def frame_rate_of(path: Path) -> float:
    """Frames per second as the file states it.

    Raises:
        InputError: the video can't be opened.
    """
    stream = _Stream(path)
    stream.close()
    return stream.frame_rate


class _Stream:
    """One video, read forwards."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._capture = cv2.VideoCapture(str(path))
        self.frame_rate = float(self._capture.get(cv2.CAP_PROP_FPS)) if self._capture.isOpened() else 0.0
        if not _MIN_FRAME_RATE <= self.frame_rate <= _MAX_FRAME_RATE:
            raise InputError(
                f"video {path} can't be opened; check that it plays, or convert it (ffmpeg -i IN -c:v libx264 OUT.mp4)"
            )
        self.num_frames = max(int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT)), 1)
        self.index = -1
        self.time_s = -1.0

    def frame_at(self, time_s: float) -> MatLike | None:
        """First frame at or after a time (within half a frame); None after the end."""
        while self.index < 0 or self.time_s < time_s - 0.5 / self.frame_rate:
            if not self._capture.grab():
                if self.index < 1:
                    raise InputError(f"video {self._path} holds no frames that decode; check that it plays")
                return None
            self.index += 1
            stamp_s = float(self._capture.get(cv2.CAP_PROP_POS_MSEC)) / 1000.0
            # Files without time stamps report 0 for every frame.
            self.time_s = stamp_s if stamp_s > self.time_s else self.index / self.frame_rate
        done, image = self._capture.retrieve()
        return image if done else None

    def close(self) -> None:
        """Let go of the file."""
        self._capture.release()


class _MotionGate:
    """Tells whether an image has moved since the last one that was kept.

    The median displacement of tracked corners, so that other cars, as long as they cover less than half of the
    corners, don't count. Slow motion adds up, because the comparison is with the last frame that was kept.
    """

    def __init__(self, min_displacement: float) -> None:
        self._threshold_px = min_displacement * _SMALL_WIDTH_PX
        self._kept: MatLike | None = None
        self._kept_corners: MatLike | None = None
        self._latest: MatLike | None = None

    def moved(self, image: MatLike) -> bool:
        """Compare with the last image for which `keep` was called; the first image has moved."""
        height = max(round(image.shape[0] * _SMALL_WIDTH_PX / image.shape[1]), 1)
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        small = cv2.resize(grey, (_SMALL_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
        self._latest = small
        if self._kept is None or self._threshold_px <= 0.0:
            return True
        corners = self._kept_corners
        if corners is not None and len(corners) >= _MIN_TRACKED:
            tracked, status, _ = cv2.calcOpticalFlowPyrLK(self._kept, small, corners, corners.copy())
            found = status.reshape(-1) == 1
            if found.sum() >= _MIN_TRACKED:
                shift = np.linalg.norm((tracked - corners).reshape(-1, 2)[found], axis=1)
                return bool(np.median(shift) >= self._threshold_px)
        # Too little texture to track, or another view altogether.
        difference = np.abs(small.astype(np.float32) - self._kept.astype(np.float32))
        return bool(difference.mean() >= _MIN_GREY_DIFFERENCE)

    def keep(self) -> None:
        """Compare with the latest image from now on."""
        self._kept = self._latest
        if self._kept is not None:
            self._kept_corners = cv2.goodFeaturesToTrack(self._kept, _MAX_FEATURES, 0.01, 5)


def _crossing(start: NDArray[np.float64], step: NDArray[np.float64], radius: float) -> float:
    """Share of ``step`` after which a point from ``start`` on leaves the circle about the origin."""
    a, b, c = float(step @ step), float(start @ step), float(start @ start) - radius**2
    return min(max((-b + math.sqrt(max(b * b - a * c, 0.0))) / a, 0.0), 1.0)


def _sample_times(sampling: Sampling) -> Iterator[float]:
    if sampling.times_s is not None:
        yield from (time for time in sampling.times_s if time >= 0.0)
        return
    index = 0
    while True:
        yield index * sampling.interval_s
        index += 1


def _make_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CityReconError(f"cannot write {path}: {error.strerror}; free some space") from error


def _write_jpeg(path: Path, image: MatLike, quality: int) -> None:
    if path.exists():
        return
    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise CityReconError(f"cannot encode {path} ({image.shape[1]}x{image.shape[0]} pixels) as JPEG")
    try:
        with atomic_file(path) as partial:
            partial.write_bytes(data.tobytes())
    except OSError as error:
        raise CityReconError(
            f"cannot write {path}: {error.strerror}; free some space or use another workspace"
        ) from error


def _remove_stale(folders: list[Path], wanted: set[str]) -> None:
    for folder in folders:
        for path in folder.iterdir():
            if path.is_file() and path.name not in wanted:
                path.unlink()
