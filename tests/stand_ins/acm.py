"""Stands in for ACMP, ACMH, ACMM and ACMMP: reads by their rules, and writes the truth as they would."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

from tests.stand_ins.common import FAULT, PinholeImage, begin, check_pair, fail, write_result

MAX_SIZE, COARSEST_SIZE = 3200, 1000
MULTI_SCALE = ("ACMM", "ACMMP")
GEOMETRIC_PASSES = {"ACMP": 2, "ACMH": 1, "ACMM": 2, "ACMMP": 2}


class Tokens:
    """What `std::ifstream >>` sees."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._tokens = path.read_text(encoding="ascii").split()[::-1]

    def word(self, expected: str) -> None:
        """A word that must be there."""
        found = self._tokens.pop()
        if found != expected:
            fail(f"{self._path}: {found} instead of {expected}")

    def floats(self, count: int) -> np.ndarray:
        """Numbers."""
        return np.array([float(self._tokens.pop()) for _ in range(count)])

    def integer(self) -> int:
        """A whole number."""
        return int(self._tokens.pop())

    def end(self) -> None:
        """Nothing may be left."""
        if self._tokens:
            fail(f"{self._path}: {len(self._tokens)} values too many")


def read_image(folder: Path, number: int) -> tuple[PinholeImage, float, float]:
    """An image with its camera file; pixel centres are whole numbers. Least and greatest depth."""
    tokens = Tokens(folder / "cams" / f"{number:08d}_cam.txt")
    tokens.word("extrinsic")
    extrinsic = tokens.floats(16).reshape(4, 4)
    if not np.array_equal(extrinsic[3], [0, 0, 0, 1]):
        fail("the last row of an extrinsic matrix is not 0 0 0 1")
    rotation = extrinsic[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6):
        fail("a rotation is none")
    tokens.word("intrinsic")
    calibration = tokens.floats(9).reshape(3, 3)
    near, _, _, far = tokens.floats(4)
    tokens.end()
    if not 0 < near < far:
        fail(f"depths from {near} to {far}")
    path = folder / "images" / f"{number:08d}.jpg"
    grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if grey is None:
        fail(f"{path} can't be read")
    if max(grey.shape) > MAX_SIZE:
        fail(f"{path} would be reduced")
    image = PinholeImage(
        grey=grey, calibration=calibration, rotation=rotation, translation=extrinsic[:3, 3], first_px=0.0
    )
    return image, near, far


def dmb(values: np.ndarray) -> bytes:
    """Header and rows, as `writeDepthDmb` and `writeNormalDmb` do."""
    height, width, channels = np.atleast_3d(values).shape
    header = np.array([1, height, width, channels], "<i4").tobytes()
    return header + np.ascontiguousarray(values, "<f4").tobytes()


def read_pairs(path: Path) -> list[list[int]]:
    """Source views per image; its number must be its place."""
    tokens = Tokens(path)
    problems = []
    for expected in range(tokens.integer()):
        number, sources = tokens.integer(), []
        for _ in range(tokens.integer()):
            source, score = tokens.integer(), tokens.floats(1)[0]
            if score > 0:
                sources.append(source)
        if number != expected or not sources or number in sources:
            fail(f"pair.txt: image {number} at place {expected} with sources {sources}")
        problems.append(sources)
    tokens.end()
    return problems


def main() -> None:
    """Do what the program does, each pass overwriting what the one before left."""
    begin("CUDA driver version is insufficient")
    program, folder = Path(sys.argv[0]).name, Path(sys.argv[1])
    problems = read_pairs(folder / "pair.txt")
    read = [read_image(folder, number) for number in range(len(problems))]
    size = max(max(image.grey.shape) for image, _, _ in read)
    scales = [1]
    while program in MULTI_SCALE and size // scales[-1] > COARSEST_SIZE:
        scales.append(2 * scales[-1])
    results = [folder / program / f"2333_{number:08d}" for number in range(len(problems))]
    for result in results:
        result.mkdir(parents=True)
    for scale in reversed(scales):
        for name in ["depths.dmb"] + ["depths_geom.dmb"] * GEOMETRIC_PASSES[program]:
            for number, (image, near, far) in enumerate(read):
                if scale == 1:
                    for source in problems[number]:
                        check_pair(image, read[source][0])
                depth = image.depth()[::scale, ::scale]
                depth[(depth < 0.6 * near) | (depth > 1.2 * far)] = 0.0
                normal = np.broadcast_to(image.normal_in_world(), (*depth.shape, 3))
                height = len(depth) - (FAULT == "foreign")
                is_last = number == len(read) - 1
                write_result(results[number] / name, dmb(depth[:height]), is_last=is_last)
                write_result(results[number] / "normals.dmb", dmb(normal[:height]), is_last=is_last)
                print(f"Processing image {number:08d} done!", flush=True)
