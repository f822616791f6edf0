"""Where an image shows the sky, which stereo would otherwise spread over the far end of a region."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

_WORKING_SIZE_PX = 640
_MAX_GRADIENT = 10.0
"""Per pixel, of 255: clouds are smoother."""
_MIN_BRIGHTNESS = 90
_MIN_SHARE_OF_HIGHLIGHTS = 0.75
_MIN_TIMES_GROUND, _MIN_GROUND = 1.25, 0.1
_MIN_BLUE_OVER_RED = 50
"""The sky is blue, or about as bright as the brightest things in the image or, where these are the sun and its glow,
brighter than all below the horizon, if that is a tenth of the image; a plain wall in the shade isn't."""
MAX_RED_OVER_BLUE = 10.0
"""Unless every sky is redder: at dusk, or in dust."""
_MIN_RED_SHARE, _MIN_RED_SHARE_OF_SKIES, _MIN_RED_AREA = 0.5, 0.8, 0.01
_MIN_IMAGES, _MAX_REDNESS_DEVIATION, _REDNESS_SPREAD = 5, 8.0, 3.0
_MIN_AREA = 0.001
"""Of the image."""
_PIXELS_PER_KEYPOINT = 2500
"""More triangulated keypoints than one per so many pixels: not the sky."""
_BORDER_PX = 4


def find_sky(
    image: NDArray[np.uint8],
    *,
    calibration: NDArray[np.float64],
    cam_from_world: NDArray[np.float64],
    keypoints_px: NDArray[np.float64],
    max_red_over_blue: float = MAX_RED_OVER_BLUE,
) -> NDArray[np.bool_]:
    """Smooth, bright, not reddish areas above the horizon that reach the image's upper border and hold no keypoints.

    The upper border is the one that is up in the world: cameras may be held upright.

    Args:
        image: (H, W, 3) blue, green, red.
        calibration: (3, 3) K in pixels.
        cam_from_world: (3, 4) [R | t], world z up.
        keypoints_px: (N, 2) pixels of the triangulated points that the image observes.
        max_red_over_blue: difference of the two colours, of 255, up to which an area isn't reddish.

    Returns:
        (H, W) True where the sky is, and a few pixels around it, where colours mix.
    """
    height, width = image.shape[:2]
    scale = min(1.0, _WORKING_SIZE_PX / max(height, width))
    small = cv2.resize(image, (round(scale * width), round(scale * height)), interpolation=cv2.INTER_AREA)
    grey = cv2.GaussianBlur(cv2.cvtColor(small, cv2.COLOR_BGR2GRAY).astype(np.float32), (0, 0), 1.0)
    gradient = np.hypot(cv2.Scharr(grey, cv2.CV_32F, 1, 0), cv2.Scharr(grey, cv2.CV_32F, 0, 1)) / 32
    brightness = small.max(axis=2)
    above = _above_horizon(small.shape[:2], scale, calibration, cam_from_world)
    bright = _MIN_SHARE_OF_HIGHLIGHTS * float(np.percentile(brightness, 98))
    if above.mean() <= 1.0 - _MIN_GROUND:
        bright = min(bright, _MIN_TIMES_GROUND * float(np.percentile(brightness[~above], 98)))
    reddish = small[:, :, 2].astype(np.int16) - small[:, :, 0]
    bright_enough = brightness >= np.where(reddish <= -_MIN_BLUE_OVER_RED, 0.0, bright).clip(min=_MIN_BRIGHTNESS)
    candidate = (gradient < _MAX_GRADIENT) & bright_enough & (reddish <= max_red_over_blue) & above
    count, labels, statistics, _ = cv2.connectedComponentsWithStats(candidate.astype(np.uint8), connectivity=4)
    row, column = (np.floor(scale * keypoints_px).astype(np.int64).T)[::-1]
    inside = (row >= 0) & (row < labels.shape[0]) & (column >= 0) & (column < labels.shape[1])
    # Those of roofs lie along the sky's edge.
    core = cv2.erode(candidate.astype(np.uint8), np.ones((2 * _BORDER_PX + 1,) * 2, np.uint8)) * labels
    keypoints = np.bincount(core[row[inside], column[inside]], minlength=count)
    area = statistics[:, cv2.CC_STAT_AREA]
    is_sky = _at_upper_border(statistics, labels.shape, cam_from_world) & (area >= _MIN_AREA * labels.size)
    is_sky &= keypoints <= area / _PIXELS_PER_KEYPOINT
    is_sky[0] = False
    grown = cv2.dilate(is_sky[labels].astype(np.uint8), np.ones((2 * _BORDER_PX + 1,) * 2, np.uint8))
    sky: NDArray[np.bool_] = cv2.resize(grown, (width, height), interpolation=cv2.INTER_NEAREST).astype(np.bool_)
    return sky


def redness_of_sky(image: NDArray[np.uint8], sky: NDArray[np.bool_]) -> float:
    """Median difference of red and blue, of 255, where a mask (H, W) says that an image shows the sky.

    Not a number where that is less than a hundredth of the image.
    """
    if sky.mean() < _MIN_RED_AREA:
        return float("nan")
    blue, _, red = image[sky].astype(np.int16).T
    return float(np.median(red - blue))


def redness_limit(redness: Sequence[float]) -> float:
    """How reddish the sky may be, from all images taken at about the same time and place.

    One image doesn't tell a sky at dusk from a plain wall that fills its upper part. If the sky seems reddish in most
    images, of the same red in all, and blue or grey in hardly any, it is the sky.

    Args:
        redness: `redness_of_sky` of each image, where `find_sky` was allowed any colour.
    """
    known = np.array([value for value in redness if np.isfinite(value)])
    reddish = known[known > MAX_RED_OVER_BLUE]
    enough = len(reddish) >= max(_MIN_IMAGES, _MIN_RED_SHARE * len(redness))
    if not enough or len(reddish) < _MIN_RED_SHARE_OF_SKIES * len(known):
        return MAX_RED_OVER_BLUE
    middle = float(np.median(reddish))
    deviation = float(np.median(np.abs(reddish - middle)))
    if deviation > _MAX_REDNESS_DEVIATION:
        return MAX_RED_OVER_BLUE
    return middle + max(MAX_RED_OVER_BLUE, _REDNESS_SPREAD * deviation)


def _at_upper_border(
    statistics: NDArray[np.int32], shape: tuple[int, ...], cam_from_world: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """(L,) whether a connected area reaches that border of the image which is up."""
    left, top, width, height = statistics[:, :4].T
    right, down, _ = cam_from_world[:, 2]
    # Undistorted images may have a black line at the border.
    near = 2 * _BORDER_PX
    borders = {
        -down: top <= near,
        -right: left <= near,
        down: top + height >= shape[0] - near,
        right: left + width >= shape[1] - near,
    }
    reached: NDArray[np.bool_] = borders[max(borders)]
    return reached


def _above_horizon(
    shape: tuple[int, int], scale: float, calibration: NDArray[np.float64], cam_from_world: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """(H, W) pixels of a scaled image whose rays go up."""
    v, u = np.mgrid[0 : shape[0], 0 : shape[1]] + 0.5
    x = (u / scale - calibration[0, 2]) / calibration[0, 0]
    y = (v / scale - calibration[1, 2]) / calibration[1, 1]
    right, down, forward = cam_from_world[:, 2]
    up: NDArray[np.bool_] = right * x + down * y + forward > 0.0
    return up
