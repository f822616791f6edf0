"""Pictures of the ground from above: dots, cells, a scale bar and a north arrow, drawn with OpenCV."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from app.clustering.kernels import cover_with_dots, mix_color
from app.clustering.map_labels import MapLabels, round_length
from app.errors import CityReconError

Image = NDArray[np.uint8]
Color = tuple[int, int, int]
"""Blue, green, red."""

WHITE: Color = (255, 255, 255)
INK: Color = (50, 46, 44)
LIGHT_GREY: Color = (205, 200, 196)
BLUE: Color = (196, 112, 40)
RED: Color = (44, 38, 200)

SCALE_BAR_PX = 46
_SHIFT = 4
_SUBPIXELS = 1 << _SHIFT
"""OpenCV draws at this fraction of a pixel."""
_SWATCH_PX = (28, 14)
_CHUNK_POSITIONS = 1 << 20


class GroundPlan:
    """An image of a rectangle of the ground; x is to the right, y is up, and both have one scale."""

    def __init__(
        self, low: NDArray[np.float64], high: NDArray[np.float64], size_px: tuple[int, int], foot_px: int = 0
    ) -> None:
        """A white image, with a rectangle in its middle as large as fits.

        Args:
            low: (2,) corner of the rectangle.
            high: (2,) opposite corner; greater.
            size_px: Width and height.
            foot_px: Height at the bottom that the rectangle leaves free.
        """
        self.image = blank(*size_px)
        room = np.array([size_px[0], size_px[1] - foot_px])
        self.px_per_unit = float((room / (high - low)).min())
        self._middle, self._middle_px = (low + high) / 2, (room - 1) / 2

    def copy(self) -> GroundPlan:
        """Another image of the same ground, so far the same."""
        other = copy.copy(self)
        other.image = self.image.copy()
        return other

    def to_pixels(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixel coordinates (..., 2) of positions (..., 2 or more); centres of pixels are whole numbers."""
        offsets = (positions[..., :2] - self._middle) * (self.px_per_unit, -self.px_per_unit)
        pixels: NDArray[np.float64] = offsets + self._middle_px
        return pixels

    def shows(self, corners: NDArray[np.float64]) -> NDArray[np.bool_]:
        """(n,) whether any of the image is in each rectangle, (n, 2, 2) lower and upper corner."""
        (left, bottom), (right, top) = self.to_pixels(corners).transpose(1, 2, 0)
        height, width = self.image.shape[:2]
        shown: NDArray[np.bool_] = (right > 0) & (left < width) & (bottom > 0) & (top < height)
        return shown

    def dots(self, positions: NDArray[np.float64], radius_px: float, color: Color, opacity: float = 1.0) -> None:
        """Smooth round dots; where several lie on each other, there is one."""
        cover = np.zeros(self.image.shape[:2], dtype=np.float32)
        for start in range(0, len(positions), _CHUNK_POSITIONS):
            pixels = self.to_pixels(positions[start : start + _CHUNK_POSITIONS])
            cover_with_dots(cover, np.ascontiguousarray(pixels), radius_px)
        self.mix(cover, color, opacity)

    def haze(self, positions: NDArray[np.float64], color: Color, opacity: float) -> None:
        """Colour pixels by how many positions are in them; time and memory are small also for millions."""
        height, width = self.image.shape[:2]
        counts = np.zeros(height * width, dtype=np.int64)
        for start in range(0, len(positions), _CHUNK_POSITIONS):
            x, y = np.round(self.to_pixels(positions[start : start + _CHUNK_POSITIONS])).T
            inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
            x, y = x[inside].astype(np.int64), y[inside].astype(np.int64)
            counts += np.bincount(y * width + x, minlength=len(counts))
        self.mix(1 - (1 - opacity) ** counts.reshape(height, width), color)

    def mix(self, shares: NDArray[np.floating], color: Color, opacity: float = 1.0) -> None:
        """Mix a colour into shares (H, W) of the pixels."""
        mix_color(self.image, shares.astype(np.float32, copy=False), opacity, color)

    def lines(self, ends: NDArray[np.float64], color: Color, thickness_px: int = 1) -> None:
        """Smooth lines between positions (n, 2 or more, 2)."""
        self._lines_px(self.to_pixels(ends), color, thickness_px)

    def _lines_px(self, ends: NDArray[np.float64], color: Color, thickness_px: int) -> None:
        fixed = np.round(np.clip(ends, -1e6, 1e6) * _SUBPIXELS).astype(np.int32)
        cv2.polylines(self.image, list(fixed), False, color, thickness_px, cv2.LINE_AA, _SHIFT)

    def boxes(self, corners: NDArray[np.float64], color: Color) -> None:
        """Filled rectangles, (n, 2, 2) lower and upper corner of each; they end on whole pixels."""
        width, height = self.image.shape[1::-1]
        ends = np.round(self.to_pixels(corners) + 0.5).clip(0, (width, height)).astype(np.int64)
        for (left, bottom), (right, top) in ends.tolist():
            self.image[top:bottom, left:right] = color

    def scale_bar(self, labels: MapLabels, text_scale: float = 0.5) -> None:
        """A bar of a round length and an arrow to the north, in the lower `SCALE_BAR_PX` rows."""
        height, width = self.image.shape[:2]
        length = round_length(0.22 * width / self.px_per_unit)
        left, bottom, bar_px = 18, height - 14, length * self.px_per_unit
        text = f"{length:g} {labels.unit}"
        right = left + max(round(bar_px), text_width(text, text_scale))
        backing(self.image, (left - 8, height - SCALE_BAR_PX), (right + 8, height))
        bar = np.array([[left, bottom - 5], [left, bottom], [left + bar_px, bottom], [left + bar_px, bottom - 5]])
        self._lines_px(bar[None], INK, 2)
        write(self.image, text, (left, bottom - 9), text_scale)
        x, y = width - 24, height - 22
        left = x - 14 - text_width(labels.up, text_scale)
        backing(self.image, (left - 6, height - SCALE_BAR_PX), (width, height))
        arrow = np.array([[x, y - 13], [x + 8, y + 11], [x, y + 5], [x - 8, y + 11]])
        cv2.fillPoly(self.image, [arrow * _SUBPIXELS], INK, cv2.LINE_AA, _SHIFT)
        write(self.image, labels.up, (left, y + 7), text_scale)

    def label(self, text: str, at_px: tuple[int, int], scale: float) -> None:
        """A text on a light ground, from its lower left corner."""
        x, y = at_px
        backing(self.image, (x - 3, y - round(30 * scale)), (x + text_width(text, scale) + 3, y + round(10 * scale)))
        write(self.image, text, at_px, scale)

    def frame(self) -> None:
        """A thin line around the image."""
        height, width = self.image.shape[:2]
        cv2.rectangle(self.image, (0, 0), (width - 1, height - 1), LIGHT_GREY, 1)


def blank(width_px: int, height_px: int) -> Image:
    """A white image."""
    return np.full((height_px, width_px, 3), 255, dtype=np.uint8)


def legend(
    image: Image, at_px: tuple[int, int], entries: Sequence[tuple[str, Color, str]], text_scale: float = 0.42
) -> None:
    """A line that explains symbols, from its lower left corner; what has no room is cut off.

    Args:
        image: To draw on.
        at_px: Lower left corner.
        entries: ``dot``, ``box``, ``line`` or ``cross``; its colour; what it means.
        text_scale: Of the texts; 1 makes letters about 20 pixels high.
    """
    x, y = at_px
    width, height = _SWATCH_PX
    left, right = np.array([[4.0, height / 2]]), np.array([[width - 4.0, height / 2]])
    for symbol, color, text in entries:
        swatch = GroundPlan(np.zeros(2), np.array([width, height]), _SWATCH_PX)
        if symbol == "box":
            swatch.boxes(np.array([[[2, 0], [width - 2, height]]]), color)
        elif symbol == "cross":
            swatch.lines(np.array([[[8, 1], [20, 13]], [[8, 13], [20, 1]]]), color, 2)
        elif symbol == "line":
            swatch.lines(np.stack([left, right], axis=1), color, 2)
        else:
            swatch.dots((left + right) / 2, 2.6, color)
        top = y - round(9 * text_scale) - height // 2
        room = image[top : top + height, x : x + width]
        room[:] = swatch.image[:, : room.shape[1]]
        write(image, text, (x + width + 6, y), text_scale)
        x += width + 22 + text_width(text, text_scale)


def write(image: Image, text: str, at_px: tuple[int, int], scale: float) -> None:
    """Write a line of text from its lower left corner; other letters than ASCII's become question marks."""
    plain = text.encode("ascii", errors="replace").decode("ascii")
    cv2.putText(image, plain, at_px, cv2.FONT_HERSHEY_SIMPLEX, scale, INK, 1, cv2.LINE_AA)


def text_width(text: str, scale: float) -> int:
    """How many pixels a text is wide."""
    return int(cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)[0][0])


def backing(image: Image, low_px: tuple[int, int], high_px: tuple[int, int]) -> None:
    """Fade what lies under a label."""
    (left, top), (right, bottom) = np.maximum([low_px, high_px], 0).tolist()
    part = image[top:bottom, left:right]
    part[:] = np.round(part * 0.15 + 0.85 * 255).astype(np.uint8)


def encode_png(image: Image, compression: int = 6) -> bytes:
    """The image as PNG; compression 9 is most and slow.

    Raises:
        CityReconError: it can't be encoded.
    """
    ok, encoded = cv2.imencode(
        ".png", image, [cv2.IMWRITE_PNG_COMPRESSION, compression, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE]
    )
    if not ok:
        raise CityReconError(f"cannot encode an image of {image.shape[1]} x {image.shape[0]} pixels")
    return encoded.tobytes()
