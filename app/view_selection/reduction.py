"""Fewer constraints with the same solutions: what makes the integer program of [O] small."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.view_selection.kernels import count_distinct, undominated


def count_views(bits: NDArray[np.uint64]) -> NDArray[np.int64]:
    """(R,) number of views in each packed row (R, words)."""
    counts = np.zeros(len(bits), dtype=np.int64)
    # Word by word: NumPy's sums over a short axis are slow.
    for word in bits.T:
        counts += np.bitwise_count(word)
    return counts


@dataclass(frozen=True, kw_only=True)
class CoveringRows:
    """Constraints "at least ``bounds[r]`` of the views in row r"."""

    bits: NDArray[np.uint64]
    """(R, words) views of each row, packed."""
    bounds: NDArray[np.int64]
    """(R,)"""

    @property
    def sizes(self) -> NDArray[np.int64]:
        """(R,) number of views in each row."""
        return count_views(self.bits)

    def __getitem__(self, rows: NDArray[np.integer] | NDArray[np.bool_]) -> CoveringRows:
        """Some of the rows."""
        return CoveringRows(bits=self.bits[rows], bounds=self.bounds[rows])


def covering_rows(
    visible: NDArray[np.uint64], usable: NDArray[np.uint64], n_vis: int
) -> tuple[CoveringRows, NDArray[np.int64]]:
    """One row per set of views that see the same points.

    Args:
        visible: (P_c, words) views that see each point, packed.
        usable: (words,) views that may be selected, packed.
        n_vis: N_vis. Where fewer usable views see a point, their number is its bound, so that all rows can be met.

    Returns:
        The distinct rows with a positive bound, and how many points have 0, 1, ... ``n_vis`` - 1 usable views.
    """
    rows_of_points = visible & usable
    first, counts = count_distinct(rows_of_points)
    distinct = rows_of_points[first]
    sizes = count_views(distinct)
    num_relaxed = np.bincount(np.minimum(sizes, n_vis), weights=counts, minlength=n_vis + 1)[:n_vis]
    rows = CoveringRows(bits=distinct, bounds=np.minimum(sizes, n_vis))
    return rows[sizes > 0], num_relaxed.astype(np.int64)


def required_views(rows: CoveringRows) -> NDArray[np.uint64]:
    """(words,) views in rows that need all of their views, packed."""
    required = np.zeros(rows.bits.shape[1], dtype=np.uint64)
    for bits in rows.bits[rows.sizes == rows.bounds]:
        required |= bits
    return required


def reduce_rows(rows: CoveringRows, fixed: NDArray[np.uint64]) -> CoveringRows:
    """Remove what is known: views that are in every solution anyway, met rows, equal rows and implied rows.

    Args:
        rows: Any covering rows.
        fixed: (words,) views that are selected in any case, packed.

    Returns:
        Rows over the other views; together with the fixed views they allow the same solutions.
    """
    bounds = rows.bounds - count_views(rows.bits & fixed)
    open_rows = CoveringRows(bits=(rows.bits & ~fixed)[bounds > 0], bounds=bounds[bounds > 0])
    # Fewer views and higher bounds first: a row can only be implied by one before it.
    order = np.lexsort((-open_rows.bounds, open_rows.sizes))
    ordered = open_rows[order]
    return ordered[undominated(ordered.bits, ordered.bounds)]
