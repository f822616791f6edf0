"""COLMAP's depth and normal maps, read value by value as its documentation describes them."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray


def read_map(path: Path) -> NDArray[np.float32]:
    """(H, W) depths or (H, W, 3) normals."""
    width, height, channels, data = path.read_bytes().split(b"&", 3)
    shape = int(height), int(width), int(channels)
    flat = np.frombuffer(data, dtype="<f4")
    values = np.empty(shape, dtype=np.float32)
    for channel in range(shape[2]):
        for row in range(shape[0]):
            start = (channel * shape[0] + row) * shape[1]
            values[row, :, channel] = flat[start : start + shape[1]]
    return values[..., 0] if shape[2] == 1 else values
