"""The first frames of the sample street, reduced in size, and the program run on them as a user runs it."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[1]
STREET = ROOT / "sample_data" / "street"
CAMERAS = ("cam0", "links \u00fc", "cam 2")
"""Folders of the cameras: file names may hold anything."""
NUM_FRAMES = 6
WIDTH, HEIGHT = 400, 250
GPS_NOISE_M = 0.02
OPTIONS = ("--preset", "preview", "--set", "sfm.max_num_features=1500", "--set", "clustering.block_size_m=[24, 24]")
"""Cheap: about half a minute of CPU time for `full`; several clusters."""


def true_poses() -> dict[str, NDArray[np.float64]]:
    """(3, 4) cam_from_world by image name."""
    entries = json.loads((STREET / "poses_gt.json").read_text(encoding="utf-8"))
    return {_renamed(entry["image"]): np.column_stack((entry["R"], entry["t"])) for entry in entries}


def center(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3,) projection centre in metres of a (3, 4) pose."""
    return np.asarray(-pose[:, :3].T @ pose[:, 3])


def _renamed(name: str) -> str:
    return f"{CAMERAS[int(name[3])]}/{name[5:]}"


def write_scene(folder: Path) -> None:
    """Write `images/`, `rig.json` and `gps.csv`."""
    for name in true_poses():
        if int(Path(name).stem) < NUM_FRAMES:
            large = cv2.imread(str(STREET / "images" / f"cam{CAMERAS.index(name.split('/')[0])}" / Path(name).name))
            small = cv2.resize(large, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
            (folder / "images" / name).parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(folder / "images" / name), small, [cv2.IMWRITE_JPEG_QUALITY, 95])
    rig = json.loads((STREET / "rig.json").read_text(encoding="utf-8"))
    for entry, camera in zip(rig[0]["cameras"], CAMERAS, strict=True):
        entry["image_prefix"] = f"{camera}/"
        entry["camera_params"] = [value * WIDTH / 640 for value in entry["camera_params"]]
    (folder / "rig.json").write_text(json.dumps(rig), encoding="utf-8")
    centers = np.array([center(true_poses()[f"{CAMERAS[0]}/{frame:06d}.jpg"]) for frame in range(NUM_FRAMES)])
    noise = np.random.default_rng(1).normal(0.0, GPS_NOISE_M, centers.shape)
    origin = json.loads((STREET / "truth.json").read_text(encoding="utf-8"))["origin_lat_lon_alt"]
    fixes = pycolmap.GPSTransform().enu_to_ellipsoid(centers + noise, *origin)
    rows = [f"{frame:06d},{lat:.9f},{lon:.9f},{alt:.4f}\n" for frame, (lat, lon, alt) in enumerate(fixes)]
    (folder / "gps.csv").write_text("frame,lat,lon,alt\n" + "".join(rows), encoding="utf-8")


def command(*arguments: str | Path, before: str = "") -> list[str]:
    """The command line of `cityrecon ARGUMENTS`; ``before`` is Python code that is run first."""
    code = f"{before}\nfrom app.cli import main\nif __name__ == '__main__': main()"
    return [sys.executable, "-c", code, *map(str, arguments)]


def environment() -> dict[str, str]:
    """For the program run from the source tree."""
    return os.environ | {"PYTHONPATH": str(ROOT)}


def cityrecon(*arguments: str | Path, before: str = "") -> subprocess.CompletedProcess[str]:
    """Run the program in a process of its own."""
    return subprocess.run(
        command(*arguments, before=before), check=False, capture_output=True, text=True, env=environment()
    )


def kill_when(moment: Callable[[], bool], *arguments: str | Path) -> None:
    """Start the program, and kill it and its processes with SIGKILL as soon as ``moment()`` is true."""
    process = subprocess.Popen(
        command(*arguments),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=environment(),
        start_new_session=True,
    )
    try:
        while not moment():
            assert process.poll() is None, "it ended before it could be killed"
            time.sleep(0.01)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def error_lines(result: subprocess.CompletedProcess[str]) -> list[str]:
    """The lines on stderr that report an error, after a check that nothing there is a traceback."""
    assert "Traceback" not in result.stderr, result.stderr
    assert "unexpected" not in result.stderr, result.stderr
    return [line for line in result.stderr.splitlines() if line.startswith("error: ")]


def refused(result: subprocess.CompletedProcess[str], *, exit_code: int = 2) -> str:
    """The one line by which the program refused its input or gave up."""
    assert result.returncode == exit_code, result.stderr
    lines = error_lines(result)
    assert len(lines) == 1, result.stderr
    return lines[0]


class FinishedRun:
    """A scene with the workspace and the cloud that `full` made of it."""

    def __init__(self, folder: Path) -> None:
        self.scene = folder / "my scene"
        self.out = folder / "town.ply"
        self.workspace = folder / "town.workspace"

    def full(self, out: Path, *more: str | Path) -> list[str | Path]:
        """The arguments of the `full` that made this run, with another output."""
        images, gps, rig = self.scene / "images", self.scene / "gps.csv", self.scene / "rig.json"
        return ["full", images, out, "--gps", gps, "--rig", rig, *OPTIONS, *more]

    def copy_to(self, folder: Path) -> Path:
        """A copy of the workspace to change; the scene is shared."""
        workspace = folder / "town.workspace"
        shutil.copytree(self.workspace, workspace)
        return workspace
