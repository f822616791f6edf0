"""Regions of the ground: unions of grid cells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


def ground_cells(
    points: NDArray[np.floating], origin_m: tuple[float, float], cell_size_m: tuple[float, float]
) -> NDArray[np.float64]:
    """(N, 2) indices of the half-open cells that (N, 2) or (N, 3) points lie in.

    Whole numbers as floats, so that points at any distance have one; points that aren't finite have none that is.
    """
    cells: NDArray[np.float64] = np.floor((points[:, :2].astype(np.float64) - origin_m) / cell_size_m)
    return cells


@dataclass(frozen=True, kw_only=True)
class GroundRegion:
    """Union of cells of a ground grid over a range of heights.

    Cell (i, j) covers the half-open square ``origin + size * [i, i+1) x [j, j+1)``, so the cells tile the plane and a
    cloud cropped to all cells of a grid keeps each point exactly once.
    """

    cells: tuple[tuple[int, int], ...]
    """Sorted cell indices (i along x, j along y)."""
    origin_m: tuple[float, float]
    """Corner of cell (0, 0)."""
    cell_size_m: tuple[float, float]
    z_range_m: tuple[float, float]
    """Robust heights of what is to be reconstructed. It bounds the search for depth; clouds aren't cropped by it."""
    padding_m: float
    """Overlap d_overlap of [O] section 3: how far the padded region reaches over each cell's border, also in z."""

    def contains(self, points: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Which of the (N, 3) or (N, 2) points lie in one of the cells; heights don't matter."""
        index = ground_cells(points, self.origin_m, self.cell_size_m)
        wanted = np.asarray(self.cells, dtype=np.int64).reshape(-1, 2)
        low, high = wanted.min(axis=0), wanted.max(axis=0)
        inside: NDArray[np.bool_] = np.all((index >= low) & (index <= high), axis=1)
        occupied = np.zeros(high - low + 1, dtype=np.bool_)
        occupied[tuple((wanted - low).T)] = True
        inside[inside] = occupied[tuple((index[inside].astype(np.int64) - low).T)]
        return inside

    def padded_boxes(self) -> NDArray[np.float64]:
        """(B, 2, 3) minimum and maximum corner of each cell, grown by the padding."""
        low = np.asarray(self.cells, dtype=np.float64).reshape(-1, 2) * self.cell_size_m + self.origin_m
        boxes = np.empty((len(low), 2, 3))
        boxes[:, 0, :2] = low - self.padding_m
        boxes[:, 1, :2] = low + self.cell_size_m + self.padding_m
        boxes[:, 0, 2] = self.z_range_m[0] - self.padding_m
        boxes[:, 1, 2] = self.z_range_m[1] + self.padding_m
        return boxes
