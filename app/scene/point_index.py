"""Finds the points in a rectangle of the ground."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

TILE_SIZE = 20.0
"""In units of the model. Scenes are stored in the order of square tiles of this size; [O]'s blocks are as large."""
_REACH = 1 << 30
"""Tiles farther from the origin than this many are taken for the last ones."""
_PIECE_POINTS = 1 << 20


def tile_keys(positions: NDArray[np.float64]) -> NDArray[np.int64]:
    """(n,) keys of the tiles that positions (n, 2 or more) lie in; they ascend with x, then y."""
    tiles = np.clip(np.floor(positions[:, :2] / TILE_SIZE), -_REACH, _REACH - 1).astype(np.int64) + _REACH
    keys: NDArray[np.int64] = tiles[:, 0] << 31 | tiles[:, 1]
    return keys


class TileCounts:
    """How many rows have each key, counted piece by piece."""

    def __init__(self) -> None:
        """Count nothing yet."""
        self._keys: list[NDArray[np.int64]] = []
        self._counts: list[NDArray[np.int64]] = []

    def add(self, keys: NDArray[np.int64]) -> None:
        """Count some rows."""
        distinct, counts = np.unique(keys, return_counts=True)
        self._keys.append(distinct)
        self._counts.append(counts)

    def total(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Ascending distinct keys, and how many rows have each."""
        if not self._keys:
            return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
        keys, slot = np.unique(np.concatenate(self._keys), return_inverse=True)
        counts = np.zeros(len(keys), dtype=np.int64)
        np.add.at(counts, slot, np.concatenate(self._counts))
        return keys, counts


class PointIndex:
    """Finds the rows of positions in a rectangle; where they are stored in the order of tiles, it is a small table."""

    def __init__(self, positions: NDArray[np.float64]) -> None:
        """Index (n, 2 or more) finite positions."""
        counts, last, self._order = TileCounts(), -1, None
        for start in range(0, len(positions), _PIECE_POINTS):
            keys = tile_keys(positions[start : start + _PIECE_POINTS])
            counts.add(keys)
            ascending = keys[0] >= last and bool(np.all(keys[1:] >= keys[:-1]))
            if not ascending:
                self._order = np.argsort(tile_keys(positions), kind="stable")
                counts = TileCounts()
                counts.add(tile_keys(positions))
                break
            last = int(keys[-1])
        self._positions = positions
        self._keys, per_tile = counts.total()
        self._starts = np.concatenate([[0], np.cumsum(per_tile)])

    def rows_between(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.int64]:
        """Ascending rows of the positions with ``low <= (x, y) <= high``."""
        first, last = tile_keys(np.stack([low, high])).tolist()
        found = []
        for column in range(first >> 31, (last >> 31) + 1):
            wanted = [column << 31 | first & (1 << 31) - 1, (column << 31 | last & (1 << 31) - 1) + 1]
            start, end = self._starts[np.searchsorted(self._keys, wanted)]
            found.append(np.arange(start, end) if self._order is None else self._order[start:end])
        rows = np.concatenate(found)
        x, y = self._positions[rows, 0], self._positions[rows, 1]
        rows = rows[(x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1])]
        return rows if self._order is None else np.sort(rows)
