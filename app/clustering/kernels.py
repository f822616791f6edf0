"""Compiled loops of clustering."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from app.scene.kernels import sees


@njit(cache=True)
def _box_is_outside(
    image_from_world: NDArray[np.float64],
    size_px: NDArray[np.float64],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
) -> bool:
    """Whether one side of the viewing frustum has the whole box on its outer side."""
    for side in range(5):
        bound = 0.0
        for column in range(4):
            z = image_from_world[2, column]
            if side == 0:
                coefficient = z
            elif side == 1:
                coefficient = image_from_world[0, column]
            elif side == 2:
                coefficient = size_px[0] * z - image_from_world[0, column]
            elif side == 3:
                coefficient = image_from_world[1, column]
            else:
                coefficient = size_px[1] * z - image_from_world[1, column]
            if column == 3:
                bound += coefficient
            else:
                bound += max(coefficient * low[column], coefficient * high[column])
        # The slack keeps rounding from throwing out what a sample on the box's border would show.
        if bound < -1e-6:
            return True
    return False


@njit(cache=True)
def cameras_with_a_view(
    keypoints: NDArray[np.float64],
    axis_x: NDArray[np.float64],
    axis_y: NDArray[np.float64],
    axis_z: NDArray[np.float64],
    image_from_world: NDArray[np.float64],
    sizes_px: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Which images have at least one keypoint or sample in front of them and inside their rectangle.

    Args:
        keypoints: (n, 3) in the world.
        axis_x: Coordinates of the samples along x; the samples are all combinations of the three axes.
        axis_y: The same along y.
        axis_z: The same along z.
        image_from_world: (m, 3, 4) K [R | t].
        sizes_px: (m, 2) width, height.

    Returns:
        (m,)
    """
    out = np.zeros(len(image_from_world), np.bool_)
    low = np.array([axis_x[0], axis_y[0], axis_z[0]])
    high = np.array([axis_x[-1], axis_y[-1], axis_z[-1]])
    for row in range(len(keypoints)):
        for axis in range(3):
            low[axis] = min(low[axis], keypoints[row, axis])
            high[axis] = max(high[axis], keypoints[row, axis])
    for camera in range(len(image_from_world)):
        matrix, size_px = image_from_world[camera], sizes_px[camera]
        if not _box_is_outside(matrix, size_px, low, high):
            out[camera] = _sees_a_sample(matrix, size_px, axis_x, axis_y, axis_z)
            for row in range(len(keypoints)):
                if out[camera]:
                    break
                out[camera] = sees(matrix, size_px, keypoints[row])
    return out


@njit(cache=True)
def _sees_a_sample(
    matrix: NDArray[np.float64],
    size_px: NDArray[np.float64],
    axis_x: NDArray[np.float64],
    axis_y: NDArray[np.float64],
    axis_z: NDArray[np.float64],
) -> bool:
    sample = np.empty(3)
    # Most images that see any sample see one of these few.
    for step in (4, 1):
        for x in axis_x[step // 2 :: step]:
            sample[0] = x
            for y in axis_y[step // 2 :: step]:
                sample[1] = y
                for z in axis_z[step // 2 :: step]:
                    sample[2] = z
                    if sees(matrix, size_px, sample):
                        return True
    return False


@njit(cache=True)
def cover_with_dots(cover: NDArray[np.float32], pixels: NDArray[np.float64], radius_px: float) -> None:
    """Raise how much of each pixel is covered, between 0 and 1, to what smooth round dots cover of it.

    Args:
        cover: (H, W) changed in place.
        pixels: (n, 2) centres of the dots, x and y; centres of pixels are whole numbers.
        radius_px: Where a dot covers half of a pixel; a pixel half a pixel farther away is free.
    """
    height, width = cover.shape
    reach = radius_px + 0.5
    for dot in range(len(pixels)):
        x, y = pixels[dot, 0], pixels[dot, 1]
        if not (-reach < x < width - 1 + reach and -reach < y < height - 1 + reach):
            continue
        for row in range(max(0, math.ceil(y - reach)), min(height - 1, math.floor(y + reach)) + 1):
            for column in range(max(0, math.ceil(x - reach)), min(width - 1, math.floor(x + reach)) + 1):
                share = min(reach - math.sqrt((column - x) ** 2 + (row - y) ** 2), 1.0)
                if share > cover[row, column]:
                    cover[row, column] = share


@njit(cache=True)
def mix_color(
    image: NDArray[np.uint8], shares: NDArray[np.float32], opacity: float, color: tuple[int, int, int]
) -> None:
    """Mix a colour into an image.

    Args:
        image: (H, W, 3) changed in place.
        shares: (H, W) how much of each pixel is painted, between 0 and 1.
        opacity: Of the paint, between 0 and 1.
        color: In the image's order.
    """
    for row in range(shares.shape[0]):
        for column in range(shares.shape[1]):
            if shares[row, column] > 0.0:
                share = opacity * shares[row, column]
                for channel in range(3):
                    before = image[row, column, channel]
                    image[row, column, channel] = np.uint8(np.rint(before + share * (color[channel] - before)))
