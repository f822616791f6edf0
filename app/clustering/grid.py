"""The ground grid: which cell a position is in, and which positions are in a range of cells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion.region import GroundRegion, ground_cells

Cell = tuple[int, int]


@dataclass(frozen=True, kw_only=True)
class GroundGrid:
    """Square cells on (x, y) in the model's units; cell (i, j) is ``origin + size * [i, i+1) x [j, j+1)``."""

    origin_m: tuple[float, float]
    block_size_m: tuple[float, float]
    overlap_m: float
    """d_overlap: how far a cell's padded bounds reach over its border."""
    sample_spacing_m: float
    """r: distance of the uniform samples in the cells."""

    def cells_of(self, positions: NDArray[np.float64]) -> NDArray[np.int64]:
        """(n, 2) cells of finite positions, (n, 2) or (n, 3)."""
        return ground_cells(positions, self.origin_m, self.block_size_m).astype(np.int64)

    def center_of(self, cell: Cell) -> NDArray[np.float64]:
        """(2,) middle of a cell."""
        center: NDArray[np.float64] = self.origin_m + (np.array(cell, dtype=np.float64) + 0.5) * self.block_size_m
        return center

    def region(self, cells: tuple[Cell, ...], z_range_m: tuple[float, float]) -> GroundRegion:
        """The union of cells as a region."""
        return GroundRegion(
            cells=cells,
            origin_m=self.origin_m,
            cell_size_m=self.block_size_m,
            z_range_m=z_range_m,
            padding_m=self.overlap_m,
        )


def outline(cells: Sequence[Cell]) -> NDArray[np.int64]:
    """(n, 2, 2) ends of the sides of the union of cells, in cells: a side between two of them isn't one."""
    inside = set(cells)
    sides = []
    for i, j in cells:
        for neighbour, ends in (
            ((i - 1, j), ((i, j), (i, j + 1))),
            ((i + 1, j), ((i + 1, j), (i + 1, j + 1))),
            ((i, j - 1), ((i, j), (i + 1, j))),
            ((i, j + 1), ((i, j + 1), (i + 1, j + 1))),
        ):
            if neighbour not in inside:
                sides.append(ends)
    return np.array(sides, dtype=np.int64).reshape(-1, 2, 2)
