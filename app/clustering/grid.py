"""The ground grid: which cell a position is in, and which positions are in a range of cells."""

from __future__ import annotations

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


class CellIndex:
    """Finds the rows whose cells lie in a rectangle of cells. Sparse: its size follows the rows, not the extent."""

    def __init__(self, cells: NDArray[np.int64]) -> None:
        """Index (n, 2) cells."""
        self._order = np.lexsort((cells[:, 1], cells[:, 0]))
        self._columns = cells[self._order, 1]
        self._lines, starts = np.unique(cells[self._order, 0], return_index=True)
        self._starts = np.append(starts, len(cells))

    def rows_between(self, low: Cell, high: Cell) -> NDArray[np.int64]:
        """Ascending rows whose cells are at least ``low`` and at most ``high`` in both directions."""
        found = []
        first, last = np.searchsorted(self._lines, [low[0], high[0] + 1])
        for line in range(first, last):
            start, end = self._starts[line], self._starts[line + 1]
            columns = self._columns[start:end]
            inside = np.searchsorted(columns, [low[1], high[1] + 1])
            found.append(self._order[start + inside[0] : start + inside[1]])
        return np.sort(np.concatenate(found)) if found else np.empty(0, dtype=np.int64)

    def rows_around(self, cell: Cell, reach: Cell) -> NDArray[np.int64]:
        """Ascending rows at most ``reach`` cells away from a cell in each direction."""
        return self.rows_between((cell[0] - reach[0], cell[1] - reach[1]), (cell[0] + reach[0], cell[1] + reach[1]))
