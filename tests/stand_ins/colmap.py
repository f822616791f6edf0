"""Stands in for `colmap patch_match_stereo`: reads by COLMAP's rules, and writes the truth as it would."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from tests.stand_ins.common import FAULT, PinholeImage, begin, check_pair, fail, write_result

KNOWN = {"depth_min", "depth_max", "geom_consistency", "filter", "num_iterations", "gpu_index", "cache_size"}


def read_image(image: pycolmap.Image, folder: Path) -> PinholeImage:
    """Pixel centres are at .5."""
    camera, pose = image.camera, image.cam_from_world()
    grey = cv2.imread(str(folder / image.name), cv2.IMREAD_GRAYSCALE)
    if camera.model.name != "PINHOLE":
        fail(f"{image.name} isn't undistorted")
    if grey is None or grey.shape != (camera.height, camera.width):
        fail(f"{image.name} isn't there, or not of its camera's size")
    return PinholeImage(
        grey=grey,
        calibration=camera.calibration_matrix(),
        rotation=pose.rotation.matrix(),
        translation=pose.translation,
        first_px=0.5,
    )


def map_bytes(values: np.ndarray) -> bytes:
    """Width, height and channels as text, then one plane after the other."""
    planes = np.atleast_3d(values).transpose(2, 0, 1)
    header = f"{planes.shape[2]}&{planes.shape[1]}&{planes.shape[0]}&".encode()
    return header + np.ascontiguousarray(planes, "<f4").tobytes()


def read_problems(path: Path) -> list[tuple[str, list[str]]]:
    """Pairs of lines, as COLMAP's `ReadProblems` does."""
    lines = [line.strip() for line in path.read_text(encoding="utf-8").splitlines()]
    lines = [line for line in lines if line and not line.startswith("#")]
    if len(lines) % 2:
        fail(f"{path}: a reference image without source images")
    return [
        (name, [source.strip() for source in sources.split(",")])
        for name, sources in zip(lines[::2], lines[1::2], strict=True)
    ]


def main() -> None:
    """Do what the program does."""
    if sys.argv[1] != "patch_match_stereo":
        fail(f"unknown command {sys.argv[1]}")
    given = {name.removeprefix("--"): value for name, value in zip(sys.argv[2::2], sys.argv[3::2], strict=True)}
    options = {name.removeprefix("PatchMatchStereo."): given.pop(name) for name in list(given) if "." in name}
    if set(given) != {"workspace_path", "config_path"} or not KNOWN.issuperset(options):
        fail(f"unknown options {given} {options}")
    begin("Dense stereo reconstruction requires CUDA, which is not available on your system.")
    print(f"GPUs {os.environ.get('CUDA_VISIBLE_DEVICES')}, {float(options['cache_size'])} GB", flush=True)
    workspace = Path(given["workspace_path"])
    model = pycolmap.Reconstruction(workspace / "sparse")
    images = {image.name: read_image(image, workspace / "images") for image in model.images.values()}
    near, far = float(options["depth_min"]), float(options["depth_max"])
    if not 0 < near < far:
        fail(f"depths from {near} to {far}")
    kind = "geometric" if int(options["geom_consistency"]) else "photometric"
    problems = read_problems(Path(given["config_path"]))
    for name, sources in problems:
        if name in sources or not sources or not {name, *sources} <= images.keys():
            fail(f"problem {name} with {sources}")
        paths = [workspace / "stereo" / f"{what}_maps" / f"{name}.{kind}.bin" for what in ("depth", "normal")]
        if all(path.exists() for path in paths):
            continue
        image = images[name]
        for source in sources:
            if (
                kind == "geometric"
                and not Path(str(paths[0]).replace(name, source).replace(kind, "photometric")).exists()
            ):
                fail(f"{source} has no photometric map")
            check_pair(image, images[source])
        depth = image.depth()
        depth[(depth < near) | (depth > far)] = 0.0
        normal = np.where((depth > 0)[..., None], image.rotation @ image.normal_in_world(), 0.0)
        height = len(depth) - (FAULT == "foreign")
        for path, values in zip(paths, (depth, normal), strict=True):
            write_result(path, map_bytes(values[:height]), is_last=name == problems[-1][0])
