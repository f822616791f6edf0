"""Stands in for `colmap patch_match_stereo`: reads its workspace by COLMAP's rules, and writes the truth as it would.

The scene is the plane `PLANE = nx ny nz offset` of the environment. `FAULT` names what is to go wrong: exit, abort,
hang, partial or wrong.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pycolmap

KNOWN = {"depth_min", "depth_max", "geom_consistency", "filter", "num_iterations", "gpu_index", "cache_size"}


def fail(message: str) -> None:
    """End as COLMAP does."""
    print(message, flush=True)
    sys.exit(1)


def rays_of(image: pycolmap.Image) -> np.ndarray:
    """(H, W, 3) camera rays with z = 1 through pixel centres, which are at .5."""
    camera = image.camera
    if camera.model.name != "PINHOLE":
        fail(f"{image.name} isn't undistorted")
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    return np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(camera.calibration_matrix()).T


def plane_depth(image: pycolmap.Image, plane: np.ndarray) -> np.ndarray:
    """(H, W)"""
    pose = image.cam_from_world()
    rays = rays_of(image) @ pose.rotation.matrix()
    return (plane[3] - plane[:3] @ image.projection_center()) / (rays @ plane[:3])


def check_pair(reference: pycolmap.Image, source: pycolmap.Image, images: Path, plane: np.ndarray) -> None:
    """The plane must look the same in both images."""
    pose, other = reference.cam_from_world(), source.cam_from_world()
    in_world = (
        rays_of(reference) * plane_depth(reference, plane)[..., None] - pose.translation
    ) @ pose.rotation.matrix()
    pixels = (in_world @ other.rotation.matrix().T + other.translation) @ source.camera.calibration_matrix().T
    maps = (pixels[..., :2] / pixels[..., 2:] - 0.5).astype(np.float32)
    grey = [cv2.imread(str(images / image.name), cv2.IMREAD_GRAYSCALE) for image in (reference, source)]
    for image, pixel in zip((reference, source), grey, strict=True):
        if pixel is None or pixel.shape != (image.camera.height, image.camera.width):
            fail(f"{image.name} isn't there, or not of its camera's size")
    warped = cv2.remap(
        grey[1].astype(np.float32), maps[..., 0], maps[..., 1], cv2.INTER_CUBIC, borderValue=float("nan")
    )
    known = np.isfinite(warped)
    if known.mean() < 0.3 or np.abs(warped[known] - grey[0][known]).mean() > 1.5:
        fail("images and cameras don't agree")


def write_map(path: Path, values: np.ndarray) -> None:
    """Width, height and channels as text, then one plane after the other."""
    planes = np.atleast_3d(values).transpose(2, 0, 1)
    header = f"{planes.shape[2]}&{planes.shape[1]}&{planes.shape[0]}&".encode()
    path.write_bytes(header + np.ascontiguousarray(planes, "<f4").tobytes())


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
    fault = os.environ.get("FAULT", "")
    plane = np.array([float(value) for value in os.environ["PLANE"].split()])
    if sys.argv[1] != "patch_match_stereo":
        fail(f"unknown command {sys.argv[1]}")
    given = {name.removeprefix("--"): value for name, value in zip(sys.argv[2::2], sys.argv[3::2], strict=True)}
    options = {name.removeprefix("PatchMatchStereo."): given.pop(name) for name in list(given) if "." in name}
    if set(given) != {"workspace_path", "config_path"} or not KNOWN.issuperset(options):
        fail(f"unknown options {given} {options}")
    if fault == "exit":
        fail("Dense stereo reconstruction requires CUDA, which is not available on your system.")
    if fault == "abort":
        os.kill(os.getpid(), signal.SIGABRT)
    if fault == "hang":
        time.sleep(600)
    workspace = Path(given["workspace_path"])
    model = pycolmap.Reconstruction(workspace / "sparse")
    images = {image.name: image for image in model.images.values()}
    near, far = float(options["depth_min"]), float(options["depth_max"])
    if not 0 < near < far:
        fail(f"depths from {near} to {far}")
    kinds = ["photometric", "geometric"] if int(options["geom_consistency"]) else ["photometric"]
    for name, sources in read_problems(Path(given["config_path"])):
        if name in sources or not sources or not {name, *sources} <= images.keys():
            fail(f"problem {name} with {sources}")
        for kind in kinds:
            paths = [workspace / "stereo" / f"{what}_maps" / f"{name}.{kind}.bin" for what in ("depth", "normal")]
            if all(path.exists() for path in paths):
                continue
            if kind == "geometric":
                for source in sources:
                    if not (workspace / "stereo" / "depth_maps" / f"{source}.photometric.bin").exists():
                        fail(f"{source} has no photometric map")
            for source in sources:
                check_pair(images[name], images[source], workspace / "images", plane)
            depth = plane_depth(images[name], plane) * (2.0 if fault == "wrong" else 1.0)
            depth[(depth < near) | (depth > far)] = 0.0
            normal = images[name].cam_from_world().rotation.matrix() @ plane[:3]
            normal = -normal if normal[2] > 0 else normal
            write_map(paths[0], depth)
            if fault == "partial":
                continue
            write_map(paths[1], np.where((depth > 0)[..., None], normal, 0.0))


if __name__ == "__main__":
    main()
