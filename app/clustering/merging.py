"""Blocks with few images join a neighbour ([O] section 3)."""

from __future__ import annotations

import heapq
from collections.abc import Iterable

import numpy as np

from app.clustering.association import Block
from app.clustering.grid import Cell

_SIDES = ((-1, 0), (0, -1), (0, 1), (1, 0))
_CORNERS = ((-1, -1), (-1, 1), (1, -1), (1, 1))


def merge_small_blocks(blocks: Iterable[Block], min_cameras: int) -> list[Block]:
    """Merge blocks with fewer than ``min_cameras`` images until none is left that has a neighbour.

    The block with the fewest images goes first. It joins, among the blocks beside it (or, if there are none, at its
    corners), the one that shares the most images with it; what is still equal is decided by the cells. The result has
    all cells of the input, each once, and depends on the set of blocks only.

    Args:
        blocks: With disjoint cells.
        min_cameras: Target set of views, 10 in [O].

    Returns:
        Blocks in the order of their first cells. Small ones among them have no neighbour at all.
    """
    block_at = {block.cells[0]: block for block in blocks}
    first_cell = {cell: first for first, block in block_at.items() for cell in block.cells}
    waiting = [(len(b.image_rows), first) for first, b in block_at.items() if len(b.image_rows) < min_cameras]
    heapq.heapify(waiting)
    while waiting:
        count, first = heapq.heappop(waiting)
        block = block_at.get(first)
        if block is None or len(block.image_rows) != count:
            continue
        neighbour = _best_neighbour(block, first_cell, block_at)
        if neighbour is None:
            continue
        merged = _union(block, neighbour)
        del block_at[first], block_at[neighbour.cells[0]]
        block_at[merged.cells[0]] = merged
        for cell in merged.cells:
            first_cell[cell] = merged.cells[0]
        if len(merged.image_rows) < min_cameras:
            heapq.heappush(waiting, (len(merged.image_rows), merged.cells[0]))
    return [block_at[first] for first in sorted(block_at)]


def _best_neighbour(block: Block, first_cell: dict[Cell, Cell], block_at: dict[Cell, Block]) -> Block | None:
    for offsets in (_SIDES, _CORNERS):
        firsts = {first_cell.get((i + di, j + dj)) for i, j in block.cells for di, dj in offsets}
        neighbours = [block_at[first] for first in firsts if first is not None and first != block.cells[0]]
        if neighbours:
            return min(neighbours, key=lambda other: (-_num_shared(block, other), other.cells[0]))
    return None


def _num_shared(a: Block, b: Block) -> int:
    return len(np.intersect1d(a.image_rows, b.image_rows, assume_unique=True))


def _union(a: Block, b: Block) -> Block:
    return Block(
        cells=tuple(sorted(a.cells + b.cells)),
        num_keypoints=a.num_keypoints + b.num_keypoints,
        z_range_m=(min(a.z_range_m[0], b.z_range_m[0]), max(a.z_range_m[1], b.z_range_m[1])),
        image_rows=np.union1d(a.image_rows, b.image_rows),
    )
