"""Unbounded tiled maps: a pool that never moves a cell, and an index that grows in all directions.

A pool reserves address space once; pages are committed as tiles are touched. Where the kernel refuses the
reservation (strict overcommit, address-space limit), or when it is used up, the pool doubles with a copy and
logs it: one slow scan.
"""

import logging
import math
import mmap
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from service.geometry.grid import TileRange, tiles_of
from service.kernels.tiles import NO_TILE, TileIndex, farthest_m2, take_slot

log = logging.getLogger(__name__)

MAP_NORESERVE = getattr(mmap, "MAP_NORESERVE", 0x4000)  # Linux; in the mmap module from Python 3.13 on
MIN_CAPACITY = 64


@dataclass(frozen=True, slots=True)
class Layer:
    """One array of a pool, with the shape and type of a tile."""

    shape: tuple[int, ...]
    dtype: npt.DTypeLike

    @property
    def tile_bytes(self) -> int:
        return int(np.prod(self.shape)) * np.dtype(self.dtype).itemsize


def reserve(layer: Layer, capacity: int) -> npt.NDArray[np.generic]:
    """A zeroed (capacity, *shape) array whose pages take no memory until touched.

    Raises OSError where the kernel refuses that much address space.
    """
    memory = mmap.mmap(
        -1, capacity * layer.tile_bytes, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | MAP_NORESERVE
    )
    return np.frombuffer(memory, dtype=layer.dtype).reshape(capacity, *layer.shape)


def reach_of(xy_base: npt.NDArray[np.float64]) -> float:
    """Distance of the farthest point, (N, 2) with N > 0, from the origin of its frame, m."""
    return math.sqrt(farthest_m2(xy_base))


class TilePool:
    """Slots for equal tiles, in one or more arrays of the same capacity."""

    def __init__(self, layers: tuple[Layer, ...], capacity: int) -> None:
        self._layers = layers
        try:
            self.arrays = [reserve(layer, capacity) for layer in layers]
        except (OSError, ValueError) as error:
            wanted = sum(capacity * layer.tile_bytes for layer in layers)
            log.warning(
                "map: the system refuses to reserve %d MB of address space (%s); the map will be copied each "
                "time it doubles. Allow overcommit, or raise the limit on address space",
                wanted >> 20,
                error,
            )
            capacity = MIN_CAPACITY
            self.arrays = [np.zeros((capacity, *layer.shape), layer.dtype) for layer in layers]
        self.free = np.empty(capacity, np.int32)
        self.counts = np.zeros(2, np.int64)

    def __getstate__(self) -> dict[str, Any]:
        """For pickle: only slots that were ever taken."""
        released, taken = self.counts.tolist()
        return {
            "layers": self._layers,
            "capacity": self.capacity,
            "arrays": [array[:taken] for array in self.arrays],
            "free": self.free[:released],
            "counts": self.counts,
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(state["layers"], state["capacity"])  # type: ignore[misc]
        released, taken = state["counts"].tolist()
        self.make_room(taken)
        for array, stored in zip(self.arrays, state["arrays"], strict=True):
            array[:taken] = stored
        self.free[:released] = state["free"]
        self.counts[:] = state["counts"]

    @property
    def capacity(self) -> int:
        return int(self.free.shape[0])

    @property
    def used_count(self) -> int:
        """Slots in use."""
        return int(self.counts[1] - self.counts[0])

    def make_room(self, tile_count: int) -> None:
        """Reserve room for so many tiles."""
        short = self.used_count + tile_count - self.capacity
        if short <= 0:
            return
        capacity = max(2 * self.capacity, self.capacity + short)
        log.warning("map: %d tiles used up; copying them to make room for %d", self.capacity, capacity)
        self.arrays = [self._copied(array, capacity) for array in self.arrays]
        free = np.empty(capacity, np.int32)
        free[: self.counts[0]] = self.free[: self.counts[0]]
        self.free = free

    def take(self, count: int) -> npt.NDArray[np.int32]:
        """Take so many slots, released ones first, after make_room. The caller fills them."""
        top = int(self.counts[0])
        again = min(count, top)
        fresh = int(self.counts[1]) + np.arange(count - again, dtype=np.int32)
        slots = np.concatenate((self.free[top - again : top], fresh)).astype(np.int32)
        self.counts[0] -= again
        self.counts[1] += count - again
        return slots

    def release(self, slots: npt.NDArray[np.int32]) -> None:
        """Release slots; they are cleared when taken again."""
        top = int(self.counts[0])
        self.free[top : top + len(slots)] = slots
        self.counts[0] = top + len(slots)

    def _copied(self, array: npt.NDArray[np.generic], capacity: int) -> npt.NDArray[np.generic]:
        wider = np.zeros((capacity, *array.shape[1:]), array.dtype)
        wider[: array.shape[0]] = array
        return wider


class TileMap:
    """The tiles of one map and their slots in the pool. Growing copies slot numbers, not cells."""

    def __init__(self, pool: TilePool) -> None:
        self.pool = pool
        self.slots = np.full((1, 1), NO_TILE, np.int32)
        self.origin = np.zeros(2, np.int64)
        self._empty = True

    def cover(self, tiles: TileRange) -> None:
        """Reserve room in index and pool for any of these tiles."""
        self.pool.make_room(tiles.tile_count)
        if self._empty:
            self.origin[:] = tiles.first_row, tiles.first_column
            self._empty = False
        row, column = int(self.origin[0]), int(self.origin[1])
        height, width = self.slots.shape
        above, left = max(row - tiles.first_row, 0), max(column - tiles.first_column, 0)
        below = max(tiles.last_row - (row + height - 1), 0)
        right = max(tiles.last_column - (column + width - 1), 0)
        if above == below == left == right == 0:
            return
        # sides grow by at least half of the present size, so growing stays rare
        above, below = (max(n, height // 2 + 1) if n else 0 for n in (above, below))
        left, right = (max(n, width // 2 + 1) if n else 0 for n in (left, right))
        slots = np.full((above + height + below, left + width + right), NO_TILE, np.int32)
        slots[above : above + height, left : left + width] = self.slots
        self.slots = slots
        self.origin = np.array([row - above, column - left], np.int64)

    def cover_around(
        self, xy_m: tuple[float, float], reach_m: float, cell_m: float, tile_bits: int, margin_cells: int = 1
    ) -> None:
        """cover() a square of half width reach_m around a position, with a margin in cells."""
        (x_m, y_m), r = xy_m, reach_m
        self.cover(tiles_of((x_m - r, y_m - r), (x_m + r, y_m + r), cell_m, tile_bits, margin_cells))

    def index(self) -> TileIndex:
        """The arrays for a kernel; valid until the next cover()."""
        return TileIndex(self.slots, self.origin, self.pool.free, self.pool.counts)

    def tiles(self, marked: npt.NDArray[np.generic] | None = None) -> list[tuple[int, int, int]]:
        """(tile row, tile column, slot) of every tile, by row and column.

        marked   by slot; if given, only tiles whose entry is not 0
        """
        rows, columns = np.nonzero(self.slots != NO_TILE)
        slots = self.slots[rows, columns]
        if marked is not None:
            is_meant = marked[slots] != 0
            rows, columns, slots = rows[is_meant], columns[is_meant], slots[is_meant]
        rows, columns = rows + self.origin[0], columns + self.origin[1]
        return list(zip(rows.tolist(), columns.tolist(), slots.tolist(), strict=True))

    def take(self, row: int, column: int) -> tuple[int, bool]:
        """Assign a slot to a tile that cover() prepared and that has none: (slot, used before)."""
        slot, used_before = take_slot(self.index(), row, column)
        return int(slot), bool(used_before)

    def drop(self, row: int, column: int) -> None:
        """Release the slot of one tile."""
        place = (row - int(self.origin[0]), column - int(self.origin[1]))
        self.pool.release(self.slots[place].reshape(1))
        self.slots[place] = NO_TILE

    def release(self) -> None:
        """Release every tile; the map is then empty."""
        self.pool.release(self.slots[self.slots != NO_TILE])
        self.slots = np.full((1, 1), NO_TILE, np.int32)
        self._empty = True

    def copy_from(self, other: "TileMap") -> None:
        """Become a copy of another map of the same pool, with tiles of its own."""
        self.release()
        taken = other.slots != NO_TILE
        count = int(np.count_nonzero(taken))
        self.pool.make_room(count)
        slots = self.pool.take(count)
        self.slots = np.full_like(other.slots, NO_TILE)
        self.slots[taken] = slots
        self.origin = other.origin.copy()
        self._empty = other._empty
        for array in self.pool.arrays:
            array[slots] = array[other.slots[taken]]
