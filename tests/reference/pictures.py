"""Slow plain twins of what pictures are drawn with."""

from __future__ import annotations

import numpy as np


def plain_cover(shape: tuple[int, int], pixels: np.ndarray, radius_px: float) -> np.ndarray:
    """(H, W) how much of each pixel is covered by the dot that covers most of it; see `cover_with_dots`."""
    rows, columns = np.indices(shape)
    cover = np.zeros(shape)
    for x, y in pixels:
        cover = np.maximum(cover, np.clip(radius_px + 0.5 - np.hypot(columns - x, rows - y), 0.0, 1.0))
    return cover


def plain_mix(image: np.ndarray, shares: np.ndarray, opacity: float, color: tuple[int, int, int]) -> np.ndarray:
    """(H, W, 3) the image with a colour mixed in; see `mix_color`."""
    alpha = opacity * shares[..., None]
    return np.rint(image * (1 - alpha) + np.array(color) * alpha).astype(np.uint8)
