"""Addressing of tiled maps: a dense index of slot numbers over a pool of equal tiles."""

from typing import NamedTuple

import numpy as np

from service.kernels.arrays import Float64_2D, Int32_1D, Int32_2D, Int64_1D
from service.kernels.compiled import inner_kernel, kernel

NO_TILE = -1


class TileIndex(NamedTuple):
    """Slots of the tiles of one map in a shared pool.

    slots    (H, W)       int32   slot of tile (origin[0] + row, origin[1] + column), or NO_TILE
    origin   (2,)         int64   tile row and tile column of slots[0, 0]
    free     (capacity,)  int32   stack of released slots
    counts   (2,)         int64   height of that stack; first slot that was never used
    """

    slots: Int32_2D
    origin: Int64_1D
    free: Int32_1D
    counts: Int64_1D


@inner_kernel
def slot_at(slots, row, column):
    """Slot at a row and column of TileIndex.slots, NO_TILE outside; for loops with hoisted arrays."""
    if row < 0 or column < 0 or row >= slots.shape[0] or column >= slots.shape[1]:
        return NO_TILE
    return slots[row, column]


@inner_kernel
def find_tile(index, tile_row, tile_column):
    """Slot of a tile, NO_TILE where it is absent or outside the index."""
    return slot_at(index.slots, tile_row - index.origin[0], tile_column - index.origin[1])


@kernel(TileIndex, int, int)
def take_slot(index, tile_row, tile_column):
    """Assign a slot to a tile that has none; index and pool must have room.

    Returns (slot, used_before); a slot used before has old cells, which the caller clears.
    """
    used_before = index.counts[0] > 0
    if used_before:
        index.counts[0] -= 1
        slot = np.int64(index.free[index.counts[0]])
    else:
        slot = index.counts[1]
        index.counts[1] += 1
    index.slots[tile_row - index.origin[0], tile_column - index.origin[1]] = slot
    return slot, used_before


@kernel(Float64_2D)
def farthest_m2(xy):
    """Largest squared distance of points, (N, 2) float64 m, from the origin, m^2."""
    farthest = 0.0
    for i in range(xy.shape[0]):
        farthest = max(farthest, xy[i, 0] * xy[i, 0] + xy[i, 1] * xy[i, 1])
    return farthest
