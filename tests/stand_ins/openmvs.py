"""Stands in for OpenMVS's InterfaceCOLMAP and DensifyPointCloud, by its file name; answers with the true maps."""

from __future__ import annotations

import struct
import sys
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from tests.stand_ins.common import FAULT, PinholeImage, begin, check_pair, fail, write_result


def read_image(image: pycolmap.Image, source: Path, max_size: int) -> PinholeImage:
    """Pixel centres are whole numbers."""
    camera, pose = image.camera, image.cam_from_world()
    grey = cv2.imread(str(source / "images" / image.name), cv2.IMREAD_GRAYSCALE)
    if camera.model.name != "PINHOLE" or grey is None or grey.shape != (camera.height, camera.width):
        fail(f"{image.name}: not undistorted, not there, or not of its camera's size")
    if max(camera.width, camera.height) > max_size:
        fail("images would be reduced")
    calibration = camera.calibration_matrix()
    calibration[:2, 2] -= 0.5
    return PinholeImage(
        grey=grey, calibration=calibration, rotation=pose.rotation.matrix(), translation=pose.translation, first_px=0.0
    )


def main() -> None:
    """Do what the program does."""
    arguments = dict(zip(sys.argv[1::2], sys.argv[2::2], strict=True))
    folder = Path(arguments["-w"])
    if Path(sys.argv[0]).name == "InterfaceCOLMAP":
        convert(folder, arguments)
    else:
        begin("error: cannot load the scene")
        densify(folder, arguments)


def convert(folder: Path, arguments: dict[str, str]) -> None:
    """Remember where the model is."""
    source = Path(arguments["--input-file"])
    if (source / "stereo").exists():
        fail("maps that are there would be imported")
    if not (source / "sparse" / "cameras.bin").exists() or not arguments["--image-folder"].endswith("/"):
        fail("no cameras, or an image folder without its slash")
    (folder / arguments["--output-file"]).write_text(str(source), encoding="utf-8")


def densify(folder: Path, arguments: dict[str, str]) -> None:
    """Maps of all images that share points with another, the last image first."""
    source = Path((folder / arguments["--input-file"]).read_text(encoding="utf-8"))
    model = pycolmap.Reconstruction(source / "sparse")
    seen = {
        image_id: {p.point3D_id for p in image.points2D if p.has_point3D()} for image_id, image in model.images.items()
    }
    neighbours = {a: [b for b in seen if b != a and seen[a] & seen[b]] for a in sorted(seen, reverse=True)}
    max_size = int(arguments["--max-resolution"])
    images = {image_id: read_image(model.image(image_id), source, max_size) for image_id in seen}
    used = [image_id for image_id, others in neighbours.items() if others]
    for number, image_id in enumerate(used):
        image = images[image_id]
        for other in neighbours[image_id]:
            check_pair(image, images[other])
        depth = image.depth()
        normal = np.broadcast_to(image.rotation @ image.normal_in_world(), (*depth.shape, 3))
        name, size = f"images/{model.image(image_id).name}".encode(), depth.shape[::-1]
        data = struct.pack("<2sBxIIIIff", b"DR", 7, *size, *size, depth.min(), depth.max())
        data += struct.pack("<H", len(name)) + name + struct.pack("<3I", 2, image_id - 1, 0)
        center = image.center + (FAULT == "foreign")
        data += b"".join(values.astype("<f8").tobytes() for values in (image.calibration, image.rotation, center))
        data += b"".join(values.astype("<f4").tobytes() for values in (depth, normal, np.ones_like(depth)))
        write_result(folder / f"depth{number:04d}.dmap", data, is_last=number == len(used) - 1)
