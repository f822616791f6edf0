"""Depth and normal maps of dense workspaces as one picture.

    python -m benchmarks.depth_pictures OUT.png WORKSPACE [WORKSPACE ...] --name cam1/000002.jpg --name cam2/000002.jpg

One row per name: the image, then depth and normals of each workspace. Near is red and far is blue, the same colours in
the whole row; black is unknown. Normals are in the camera's frame: x red, y green, z blue.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mvs_backends.colmap_maps import read_map


def main() -> None:
    """Write the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("workspaces", type=Path, nargs="+")
    parser.add_argument("--name", action="append", required=True, dest="names")
    parser.add_argument("--width", type=int, default=320)
    arguments = parser.parse_args()
    for folder in arguments.workspaces:
        for name in arguments.names:
            if not (folder / "stereo" / "depth_maps" / f"{name}.geometric.bin").exists():
                parser.error(f"{folder} has no depth map of {name}")
    rows = [_row(arguments.workspaces, name, arguments.width) for name in arguments.names]
    cv2.imwrite(str(arguments.out), np.concatenate(rows))


def _row(workspaces: list[Path], name: str, width: int) -> NDArray[np.uint8]:
    pictures = [cv2.imread(str(workspaces[0] / "images" / name))]
    depths = [read_map(folder / "stereo" / "depth_maps" / f"{name}.geometric.bin") for folder in workspaces]
    normals = [read_map(folder / "stereo" / "normal_maps" / f"{name}.geometric.bin") for folder in workspaces]
    nearest = np.percentile(np.concatenate([depth[depth > 0] for depth in depths]), 1)
    for depth, normal in zip(depths, normals, strict=True):
        known = depth > 0
        nearness = np.uint8(255 * np.minimum(nearest / np.where(known, depth, np.inf), 1))
        pictures.append(np.where(known[..., None], cv2.applyColorMap(nearness, cv2.COLORMAP_TURBO), 0).astype(np.uint8))
        pictures.append(np.where(known[..., None], 127.5 * (normal[..., ::-1] + 1), 0).astype(np.uint8))
    height = round(width * pictures[0].shape[0] / pictures[0].shape[1])
    return np.concatenate([cv2.resize(p, (width, height), interpolation=cv2.INTER_AREA) for p in pictures], axis=1)


if __name__ == "__main__":
    main()
