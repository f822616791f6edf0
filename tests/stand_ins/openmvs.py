"""Stands in for OpenMVS's InterfaceCOLMAP and DensifyPointCloud, by its file name; answers with the true maps.

The scene is the plane `PLANE = nx ny nz offset` of the environment. `FAULT` names what is to go wrong: exit, none,
short or pose.
"""

from __future__ import annotations

import os
import struct
import sys
from pathlib import Path

import numpy as np
import pycolmap


def fail(message: str) -> None:
    """End with a message."""
    print(message, flush=True)
    sys.exit(1)


def main() -> None:
    """Do what the program does."""
    program, fault = Path(sys.argv[0]).name, os.environ.get("FAULT", "")
    arguments = dict(zip(sys.argv[1::2], sys.argv[2::2], strict=True))
    folder = Path(arguments["-w"])
    if program == "InterfaceCOLMAP":
        source = Path(arguments["--input-file"])
        if (source / "stereo").exists():
            fail("maps that are there would be imported")
        if not (source / "sparse" / "cameras.bin").exists() or not arguments["--image-folder"].endswith("/"):
            fail("no cameras, or an image folder without its slash")
        (folder / arguments["--output-file"]).write_text(str(source), encoding="utf-8")
        return
    if fault == "exit":
        fail("error: cannot load the scene")
    source = Path((folder / arguments["--input-file"]).read_text(encoding="utf-8"))
    model = pycolmap.Reconstruction(source / "sparse")
    plane = np.array([float(value) for value in os.environ["PLANE"].split()])
    for number, image_id in enumerate(sorted(model.images, reverse=True)):
        image, camera = model.image(image_id), model.image(image_id).camera
        if camera.model.name != "PINHOLE" or not (source / "images" / image.name).exists():
            fail(f"{image.name}: not undistorted, or not there")
        if max(camera.width, camera.height) != int(arguments["--max-resolution"]):
            fail("images would be reduced")
        calibration = camera.calibration_matrix()
        calibration[:2, 2] -= 0.5
        pose, center = image.cam_from_world(), image.projection_center()
        rotation = pose.rotation.matrix()
        pixels = np.stack([*np.meshgrid(np.arange(camera.width), np.arange(camera.height))], axis=-1)
        rays = np.concatenate([pixels, np.ones((*pixels.shape[:2], 1))], axis=-1) @ np.linalg.inv(calibration).T
        depth = (plane[3] - plane[:3] @ center) / (rays @ rotation @ plane[:3])
        normal = np.broadcast_to(rotation @ -plane[:3], rays.shape)
        name = f"images/{image.name}".encode()
        size = camera.width, camera.height
        data = struct.pack("<2sBxIIIIff", b"DR", 7, *size, *size, depth.min(), depth.max())
        data += struct.pack("<H", len(name)) + name + struct.pack("<3I", 2, image_id - 1, 0)
        data += b"".join(a.astype("<f8").tobytes() for a in (calibration, rotation, center + (fault == "pose")))
        data += depth.astype("<f4").tobytes() + normal.astype("<f4").tobytes() + np.ones_like(depth, "<f4").tobytes()
        if fault != "none":
            (folder / f"depth{number:04d}.dmap").write_bytes(data[: 5000 if fault == "short" else None])


if __name__ == "__main__":
    main()
