"""Nanoseconds of one matching cost: bilateral, 32 samples, bilinear, of a plane in one source view; one core.

python -m benchmarks.ncc_kernel IMAGE
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numba import njit

from benchmarks.machine import describe_machine
from mvs_backends.patchmatch.cost.kernels import (
    COMPILED,
    PADDING,
    Sources,
    new_scratch,
    pack_neighbours,
    sample_reference,
    view_cost,
)
from mvs_backends.patchmatch.options import PatchMatchOptions
from mvs_backends.patchmatch.search import window

_COSTS = 2_000_000


@njit(**COMPILED)  # type: ignore[untyped-decorator]
def _costs(count: int, width: int, height: int, variance: Any, sources: Any, matching: Any, scratch: Any) -> float:
    total = np.float32(0)
    zero, w = np.float32(0), np.float32(0.1)
    for i in range(count):
        x, y = 20 + (i * 7) % (width - 40), 20 + (i // 64) % (height - 40)
        total += view_cost(i & 3, x, y, w, zero, zero, variance, sources, matching, scratch)
    return float(total)


@njit(**COMPILED)  # type: ignore[untyped-decorator]
def _patches(count: int, width: int, height: int, grey: Any, matching: Any, scratch: Any) -> float:
    total = np.float32(0)
    for i in range(count):
        x, y = 20 + (i * 7) % (width - 40), 20 + (i // 64) % (height - 40)
        total += sample_reference(grey, x, y, matching, scratch.weight, scratch.centred)
    return float(total)


def main() -> None:
    """Print the best of five rounds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("image", type=Path)
    grey = np.asarray(cv2.imread(str(parser.parse_args().image), cv2.IMREAD_GRAYSCALE), np.uint8)
    height, width = grey.shape
    packed = np.empty(grey.size, np.uint32)
    pack_neighbours(grey, packed)
    warp = np.array([[1.01, 0.02, i, 0.01, 0.99, 1, 1e-5, 1e-5, 1, 50, 0, 0.1] for i in range(4)], np.float32)
    sources = Sources(
        warp=warp,
        texels=packed,
        first=np.zeros(4, np.uint64),
        width=np.full(4, width, np.int32),
        height=np.full(4, height, np.int32),
        limit=np.tile(np.array([width - 1.01, height - 1.01], np.float32), (4, 1)),
        planes=np.zeros((0, 3), np.float32),
        warp_back=warp,
    )
    matching, scratch = window(PatchMatchOptions()), new_scratch(4)
    padded = np.pad(grey, PADDING, mode="edge")
    variance = np.float32(sample_reference(padded, 100, 100, matching, scratch.weight, scratch.centred))
    print(describe_machine())
    for name, kernel, arguments in (
        ("cost in one view", _costs, (width, height, variance, sources, matching, scratch)),
        ("reference patch", _patches, (width, height, padded, matching, scratch)),
    ):
        kernel(10, *arguments)
        rounds = []
        for _ in range(5):
            started = time.process_time()
            kernel(_COSTS, *arguments)
            rounds.append((time.process_time() - started) / _COSTS * 1e9)
        print(f"{name:20} {min(rounds):6.1f} ns")


if __name__ == "__main__":
    main()
