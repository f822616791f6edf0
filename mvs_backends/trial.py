"""Trial jobs: whether a back-end works on this machine is found by trying, and remembered for a while.

Remembered in `colmap_trials.json` in the user's cache folder, so that not every command tries again.
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Callable
from dataclasses import asdict, dataclass
from datetime import datetime, timedelta
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from mvs_backends.base import MvsJob, MvsView
from mvs_backends.colmap_maps import read_map

logger = logging.getLogger(__name__)

_FAILURE_HOLDS = timedelta(hours=1)
"""The GPU may have been busy. A success holds as long as program, driver and GPUs are the same."""
_MAX_REMEMBERED = 20
_MAX_ERROR = 0.02
_MIN_SHARE = 0.25
"""The images' borders and what is seen by one neighbour only may stay empty."""


@dataclass(frozen=True)
class Trial:
    """How a trial job went."""

    problem: str | None
    """Why it failed; None if it worked."""
    time: str
    """When, local time."""


def trials_file() -> Path:
    """Where trials are remembered."""
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(cache) / "cityrecon" / "colmap_trials.json"


def try_once(subject: str, attempt: Callable[[], str | None]) -> Trial:
    """Try, or remember how it went.

    Args:
        subject: what is tried and on what: program, version, GPUs, driver. Another one is tried anew.
        attempt: does a trial job, and returns why it failed, or None.
    """
    now = datetime.now().replace(microsecond=0)
    known = _read_trials()
    trial = known.pop(subject, None)
    if trial is None or (trial.problem and abs(now - datetime.fromisoformat(trial.time)) > _FAILURE_HOLDS):
        trial = Trial(problem=attempt(), time=now.isoformat(sep=" "))
        newest = sorted(known.items(), key=lambda item: item[1].time)[-_MAX_REMEMBERED + 1 :]
        _write_trials({**dict(newest), subject: trial})
    return trial


def _read_trials() -> dict[str, Trial]:
    try:
        data = json.loads(trials_file().read_text(encoding="utf-8"))
        trials = {subject: Trial(**trial) for subject, trial in data.items()}
        for trial in trials.values():
            datetime.fromisoformat(trial.time)
    except (OSError, ValueError, TypeError, AttributeError):
        return {}
    return trials


def _write_trials(trials: dict[str, Trial]) -> None:
    path = trials_file()
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_text(json.dumps({s: asdict(t) for s, t in trials.items()}, indent=1) + "\n", encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        logger.debug("%s can't be written, so the next command tries again: %s", path, error)


def trial_job(folder: Path) -> tuple[MvsJob, float]:
    """Three views side by side of a textured plane parallel to the images, each 16 pixels on.

    That is 6 degrees apart in the middle and more than 4 everywhere: COLMAP drops what its views see at less than 3.

    Returns:
        The job, its workspace in `folder`, and the plane's depth.
    """
    width, height, focal_px, step_px, depth = 160, 120, 150.0, 16, 10.0
    texture = cv2.GaussianBlur(
        np.random.default_rng(0).integers(0, 256, (height, width + 64)).astype(np.float32), (5, 5), 1
    )
    calibration = np.array([[focal_px, 0, width / 2], [0, focal_px, height / 2], [0, 0, 1.0]])
    for name in ("images", "sparse", "stereo/depth_maps", "stereo/normal_maps"):
        (folder / name).mkdir(parents=True)
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(
            camera_id=1, model="PINHOLE", width=width, height=height, params=[focal_px, focal_px, width / 2, height / 2]
        )
    )
    views = []
    for index in range(3):
        pose = np.column_stack([np.eye(3), [-index * step_px * depth / focal_px, 0.0, 0.0]])
        views.append(
            MvsView(name=f"{index}.png", width=width, height=height, calibration=calibration, cam_from_world=pose)
        )
        image = pycolmap.Image(name=f"{index}.png", camera_id=1, image_id=index + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
        pixels = texture[:, index * step_px : index * step_px + width].round().astype(np.uint8)
        cv2.imwrite(str(folder / "images" / f"{index}.png"), pixels)
    model.write_binary(folder / "sparse")
    none = np.zeros(0, np.int64)
    job = MvsJob(
        workspace=folder,
        views=tuple(views),
        sources=((1, 2), (0, 2), (0, 1)),
        boxes_in_world=np.array([[[-50.0, -50.0, 0.5 * depth], [50.0, 50.0, 2.0 * depth]]]),
        points_in_world=np.zeros((0, 3)),
        point_views=(none, none, none),
    )
    return job, depth


def is_right(job: MvsJob, depth: float) -> bool:
    """Whether the middle view of a trial job shows its plane."""
    found = read_map(job.depth_map_path(1))
    return bool(np.mean(np.abs(found / depth - 1) <= _MAX_ERROR) >= _MIN_SHARE)
