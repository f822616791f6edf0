"""Known camera poses from a text file: COLMAP's images.txt, TUM's or KITTI's format, told from the content."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from app.capture.inventory import FrameEntry
from app.capture.matching import FrameIndex, frame_number
from app.capture.scan import stem_of
from app.capture.tables import read_text
from app.errors import InputError

_MAX_TIME_DIFFERENCE_S = 0.02
_MAX_ROTATION_ERROR = 0.02


class PoseFormat(StrEnum):
    """How a pose file is laid out."""

    COLMAP = "colmap"
    """`ID QW QX QY QZ TX TY TZ CAMERA_ID NAME` (cam_from_world), every second line holds 2D points."""
    TUM = "tum"
    """`timestamp tx ty tz qx qy qz qw` (world_from_cam)."""
    KITTI = "kitti"
    """12 numbers, the rows of the 3 x 4 matrix world_from_cam; line k (from 0) is frame k."""


@dataclass(frozen=True, kw_only=True)
class PoseFile:
    """Poses in the order of the file. R rows."""

    path: Path
    format: PoseFormat
    keys: tuple[str, ...]
    """(R,) image name for COLMAP, timestamp in seconds as written for TUM, line number from 0 for KITTI."""
    world_from_cam: NDArray[np.float64]
    """(R, 4, 4) rigid; camera x right, y down, z forward. The unit of length is metres for TUM and KITTI."""

    @property
    def cam_from_world(self) -> NDArray[np.float64]:
        """(R, 4, 4) the inverse."""
        rotation = self.world_from_cam[:, :3, :3].transpose(0, 2, 1)
        inverse = np.tile(np.eye(4), (len(rotation), 1, 1))
        inverse[:, :3, :3] = rotation
        inverse[:, :3, 3] = -np.einsum("nij,nj->ni", rotation, self.world_from_cam[:, :3, 3])
        return inverse

    @property
    def is_metric(self) -> bool:
        """TUM and KITTI files are in metres by definition; a COLMAP model has any scale."""
        return self.format is not PoseFormat.COLMAP


def is_pose_file(path: Path) -> bool:
    """Whether a file's first line that isn't a comment looks like a pose, and not like a table of GPS positions."""
    lines = (line.split() for line in read_text(path).splitlines() if line.strip() and not line.startswith("#"))
    cells = next(lines, [])
    return len(cells) >= 8 and all(_is_number(cell) for cell in cells[:8])


def read_pose_file(path: Path) -> PoseFile:
    """Read poses.

    Raises:
        InputError: the file can't be read, its format isn't known, or a line holds no valid pose.
    """
    lines = list(enumerate(read_text(path).splitlines(), start=1))
    rows = [(number, line.split()) for number, line in lines if line.strip() and not line.lstrip().startswith("#")]
    if not rows:
        raise InputError(f"{path} holds no poses; give COLMAP's images.txt, or a file in TUM's or KITTI's format")
    pose_format = _detect(path, rows[0][1])
    if pose_format is PoseFormat.COLMAP:
        return _read_colmap(path, lines)
    width = 8 if pose_format is PoseFormat.TUM else 12
    values = np.empty((len(rows), width))
    for row, (number, cells) in enumerate(rows):
        values[row] = _numbers(path, number, cells, width)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    if pose_format is PoseFormat.TUM:
        poses[:, :3, :3] = _rotations(path, rows, values[:, [7, 4, 5, 6]])
        poses[:, :3, 3] = values[:, 1:4]
        keys = tuple(cells[0] for _, cells in rows)
    else:
        poses[:, :3, :] = values.reshape(-1, 3, 4)
        poses[:, :3, :3] = _nearest_rotations(path, rows, poses[:, :3, :3])
        keys = tuple(str(index) for index in range(len(rows)))
    if len(set(keys)) < len(keys):
        raise InputError(f"{path}: a timestamp is there twice; keep one line per timestamp")
    return PoseFile(path=path, format=pose_format, keys=keys, world_from_cam=poses)


def match_poses(
    poses: PoseFile, frames: Sequence[FrameEntry], *, reference_camera: str | None = None
) -> dict[str, NDArray[np.float64]]:
    """Find the pose of each image.

    COLMAP rows belong to the image of that name. TUM and KITTI rows belong to the frame's image of the reference
    camera: by time (file stems that are timestamps, or times of video frames; up to 0.02 s apart), else by frame
    number, else in order if there are as many rows as frames.

    Args:
        poses: the file.
        frames: in order of capture.
        reference_camera: camera name; the first of each frame's cameras that comes first in the first frame if None.

    Returns:
        Image name to (4, 4) world_from_cam.

    Raises:
        InputError: no row fits any frame.
    """
    found: dict[str, NDArray[np.float64]] = {}
    if poses.format is PoseFormat.COLMAP:
        index = FrameIndex(frames)
        names = {image for frame in frames for image in frame.images.values()}
        for key, pose in zip(poses.keys, poses.world_from_cam, strict=True):
            frame = index.find(key)
            if key in names:
                found[key] = pose
            elif frame is not None and len(frame.images) == 1:
                found[next(iter(frame.images.values()))] = pose
    else:
        camera = next(iter(frames[0].images)) if reference_camera is None else reference_camera
        targets = [(frame, frame.images[camera]) for frame in frames if camera in frame.images]
        rows = _rows_of_frames(poses, [frame for frame, _ in targets])
        found = {
            image: poses.world_from_cam[row] for (_, image), row in zip(targets, rows, strict=True) if row is not None
        }
    if not found:
        raise InputError(
            f"{poses.path}: none of its {len(poses.keys)} poses ({poses.format} format, first {poses.keys[0]!r}) fits "
            f"a frame (first {frames[0].name!r}); name frames by number or timestamp, or give one pose per frame"
        )
    return found


def _rows_of_frames(poses: PoseFile, frames: Sequence[FrameEntry]) -> list[int | None]:
    """Row of each frame, None where it has none."""
    if poses.format is PoseFormat.TUM:
        times = [frame.time_s if frame.time_s is not None else _timestamp(frame) for frame in frames]
        stamps = np.array([float(key) for key in poses.keys])
        order = np.argsort(stamps, kind="stable")
        rows: list[int | None] = []
        for time in times:
            row = None if time is None else _nearest(stamps, order, time)
            rows.append(row)
        if any(row is not None for row in rows):
            return rows
    else:
        numbers = [frame_number(frame) for frame in frames]
        known = [number for number in numbers if number is not None]
        if known and max(known) < len(poses.keys) and len(set(known)) == len(frames):
            return list(numbers)
    return list(range(len(frames))) if len(frames) == len(poses.keys) else [None] * len(frames)


def _timestamp(frame: FrameEntry) -> float | None:
    try:
        value = float(stem_of(next(iter(frame.images.values()))))
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def _nearest(stamps: NDArray[np.float64], order: NDArray[np.intp], time: float) -> int | None:
    position = int(np.searchsorted(stamps[order], time))
    candidates = order[max(position - 1, 0) : position + 1]
    best = int(min(candidates, key=lambda row: abs(float(stamps[row]) - time)))
    return best if abs(float(stamps[best]) - time) <= _MAX_TIME_DIFFERENCE_S else None


def _detect(path: Path, cells: list[str]) -> PoseFormat:
    numeric = [_is_number(cell) for cell in cells]
    if all(numeric) and len(cells) == 12:
        return PoseFormat.KITTI
    if all(numeric) and len(cells) == 8:
        return PoseFormat.TUM
    if len(cells) >= 10 and all(numeric[:9]) and cells[0].isdigit() and cells[8].isdigit():
        return PoseFormat.COLMAP
    raise InputError(
        f"{path}: a line with {len(cells)} values is no known pose format; give COLMAP's images.txt (10 values), "
        "TUM's (8) or KITTI's (12)"
    )


def _read_colmap(path: Path, lines: Sequence[tuple[int, str]]) -> PoseFile:
    content = [(number, line) for number, line in lines if not line.lstrip().startswith("#")]
    while content and not content[0][1].strip():
        content.pop(0)
    # Every second line holds 2D points, and is empty for an image without any.
    rows = [(number, line.split(maxsplit=9)) for number, line in content[::2] if line.strip()]
    quaternions = np.empty((len(rows), 4))
    translations = np.empty((len(rows), 3))
    keys = []
    for row, (number, cells) in enumerate(rows):
        values = _numbers(path, number, cells[:9], 9)
        if len(cells) < 10:
            raise InputError(f"{path}, line {number}: no image name; correct or remove the line")
        quaternions[row], translations[row] = values[1:5], values[5:8]
        keys.append(cells[9].rstrip())
    if len(set(keys)) < len(keys):
        raise InputError(f"{path}: an image name is there twice; keep one pose per image")
    rotation = _rotations(path, rows, quaternions).transpose(0, 2, 1)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = rotation
    poses[:, :3, 3] = -np.einsum("nij,nj->ni", rotation, translations)
    return PoseFile(path=path, format=PoseFormat.COLMAP, keys=tuple(keys), world_from_cam=poses)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _numbers(path: Path, number: int, cells: Sequence[str], width: int) -> list[float]:
    values = [float(cell) if _is_number(cell) else math.nan for cell in cells]
    if len(values) != width or not all(math.isfinite(value) for value in values):
        raise InputError(f"{path}, line {number}: needs {width} finite numbers; correct or remove the line")
    return values


def _rotations(path: Path, rows: Sequence[tuple[int, list[str]]], wxyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """(R, 3, 3) rotation matrices of (R, 4) quaternions of about unit length."""
    norm = np.linalg.norm(wxyz, axis=1)
    for row in np.flatnonzero(np.abs(norm - 1.0) > _MAX_ROTATION_ERROR)[:1]:
        raise InputError(
            f"{path}, line {rows[row][0]}: its quaternion has length {norm[row]:g}, not 1; correct the line"
        )
    w, x, y, z = (wxyz / norm[:, None]).T
    matrix = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return matrix.transpose(2, 0, 1)


def _nearest_rotations(
    path: Path, rows: Sequence[tuple[int, list[str]]], matrices: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The rotations nearest to (R, 3, 3) matrices that are nearly rotations."""
    u, _, vt = np.linalg.svd(matrices)
    nearest: NDArray[np.float64] = u @ vt
    wrong = (np.abs(nearest - matrices).max(axis=(1, 2)) > _MAX_ROTATION_ERROR) | (np.linalg.det(nearest) < 0.0)
    for row in np.flatnonzero(wrong)[:1]:
        raise InputError(f"{path}, line {rows[row][0]}: its 3 x 3 part is not a rotation; correct the line")
    return nearest
