"""The map as tiles with versions, kept for subscribers, checkpoints, the picture of the complete map.

Tiles come from the mapping thread; everything else reads. An update never waits for a picture in the making.
"""

import math
import threading
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from service.errors import StorageError
from service.geometry.geo_reference import GeoReference
from service.outputs import UNKNOWN, Grid, TileUpdate

MAX_GRID_CELLS = 2**26  # 64 MiB, 410 m square at 5 cm; a larger message helps no subscriber: they take tiles
MIN_SPARE_TILES = 4  # how far the canvas grows beyond the tile that made it grow, at least

EDGE = 64  # cells along a tile that is made of a grid

TileKey = tuple[int, int, int]  # level, ix, iy
Place = npt.NDArray[np.int64]  # (2,) row and column of a tile


@dataclass(frozen=True, slots=True)
class NumberedMap:
    """One of the maps that a run made one after another."""

    number: int  # from 1
    tiles: list[TileUpdate]  # oldest change first
    geo: GeoReference | None = None  # where it lies on the earth; None: that is not known
    graph: Path | None = None  # folder of what a later session goes on with; None: there is nothing

    @property
    def version(self) -> int:
        """Of the newest tile; 0 where there is none."""
        return self.tiles[-1].version if self.tiles else 0


class TileStore:
    """The newest version of every tile. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._graph_kept = threading.Condition(self._lock)
        self._tiles: dict[TileKey, TileUpdate] = {}
        self._version = 0
        self._stale: dict[TileKey, TileUpdate] = {}  # level 0, not yet rendered
        self._rendering = threading.Lock()  # holds `_canvas`; taken before `_lock`
        self._canvas = _Canvas()
        self._blank: TileUpdate | None = None  # first tile of a new canvas, to be begun with the next picture
        self._number = 1
        self._began_version = 0  # tiles up to this one are of maps before, emptied
        self._ended: list[NumberedMap] = []
        self._geo: GeoReference | None = None  # of the present map
        self._graph: Path | None = None  # of the present map

    @property
    def number(self) -> int:
        """Counts the maps: rises with each `start_over` that had something to empty."""
        return self._number

    @property
    def version(self) -> int:
        """The highest version kept; 0 while the map is empty."""
        return self._version

    @property
    def finest_count(self) -> int:
        """Tiles of the present map at its finest level."""
        return len(self._finest())

    @property
    def extent_m(self) -> tuple[float, float]:
        """Width (x) and height (y) that the tiles of the present map cover, m; zeros while it is empty."""
        tiles = self._finest()
        if not tiles:
            return 0.0, 0.0
        edge_m = tiles[0].cells.shape[0] * tiles[0].cell_m
        columns, rows = [tile.ix for tile in tiles], [tile.iy for tile in tiles]
        return (max(columns) - min(columns) + 1) * edge_m, (max(rows) - min(rows) + 1) * edge_m

    def update(self, tiles: Iterable[TileUpdate]) -> int:
        """Take tiles in; one that is not newer than what is kept is left out. Returns how many were taken."""
        taken = 0
        with self._lock:
            for tile in tiles:
                key = (tile.level, tile.ix, tile.iy)
                stored = self._tiles.get(key)
                if stored is not None and stored.version >= tile.version:
                    continue
                self._tiles[key] = tile
                self._version = max(self._version, tile.version)
                if tile.level == 0:
                    self._stale[key] = tile
                taken += 1
        return taken

    def place(self, geo: GeoReference | None) -> None:
        """Set where the present map lies on the earth."""
        with self._lock:
            self._geo = geo

    def keep_graph(self, folder: Path | None) -> None:
        """Set where the graph of the present map lies as it was last put away."""
        with self._graph_kept:
            self._graph = folder
            self._graph_kept.notify_all()

    @property
    def graph(self) -> Path | None:
        """Where the graph of the present map was put away last; None: nowhere yet."""
        return self._graph

    def wait_for_graph(self, other_than: Path | None, timeout_s: float) -> bool:
        """Until the graph is put away again; whether that came in time."""
        with self._graph_kept:
            return self._graph_kept.wait_for(lambda: self._graph not in (None, other_than), timeout_s)

    def since(self, version: int) -> list[TileUpdate]:
        """Every tile newer than `version`, oldest change first; 0 gives the complete map.

        Tiles of an emptied map are among them, all unknown: who holds them has to hear that they are gone.
        """
        with self._lock:
            newer = self._newer(version)
        return _by_version(newer)

    def start_over(self) -> list[TileUpdate]:
        """Empty the map, and give its tiles back as they are now: unknown, with new versions.

        The map as it was waits for `take`. Tiles of the next map need versions above `version`.
        """
        with self._lock:
            geo, self._geo = self._geo, None
            graph, self._graph = self._graph, None
            ended = _by_version(self._newer(self._began_version))
            if not ended:
                return []
            self._ended.append(NumberedMap(self._number, ended, geo, graph))
            self._number += 1
            emptied = [
                replace(tile, version=self._version + k, cells=_unknown(tile))
                for k, tile in enumerate(ended, start=1)
            ]
            self._tiles.update({(tile.level, tile.ix, tile.iy): tile for tile in emptied})
            self._version = self._began_version = emptied[-1].version
            self._stale = {}
            self._blank = replace(emptied[-1], level=0, ix=0, iy=0)  # where the next map begins
        return emptied

    def take(self) -> tuple[list[NumberedMap], NumberedMap]:
        """Maps ended since the last call, oldest first, and the present one, all at one moment."""
        with self._lock:
            ended, self._ended = self._ended, []
            present = _by_version(self._newer(self._began_version))
            return ended, NumberedMap(self._number, present, self._geo, self._graph)

    def grid(self) -> Grid | None:
        """The finest level as one picture, None while it is empty; renders only what changed meanwhile.

        Of an emptied map it is one tile of unknown cells, so that who shows a map sees it go. Raises
        StorageError beyond MAX_GRID_CELLS.
        """
        with self._rendering:
            with self._lock:
                stale, self._stale = self._stale, {}
                if self._blank is not None:
                    self._canvas, stale = _Canvas(), {(0, 0, 0): self._blank} | stale
                    self._blank = None
            self._canvas.render(stale.values())
            return self._canvas.grid()

    def _finest(self) -> list[TileUpdate]:
        with self._lock:
            return [tile for tile in self._newer(self._began_version) if tile.level == 0]

    def _newer(self, version: int) -> list[TileUpdate]:
        return [tile for tile in self._tiles.values() if tile.version > version]


def _by_version(tiles: list[TileUpdate]) -> list[TileUpdate]:
    return sorted(tiles, key=lambda tile: tile.version)


def _unknown(tile: TileUpdate) -> npt.NDArray[np.int8]:
    """Shares one cell's memory among all, however many tiles a map had."""
    return np.broadcast_to(np.int8(UNKNOWN), tile.cells.shape)


class _Canvas:
    """One array that grows to where the tiles are. Places are row and column of tiles: iy, ix."""

    def __init__(self) -> None:
        self._tiles: dict[tuple[int, int], TileUpdate] = {}  # to be rendered, by place
        self._cells: npt.NDArray[np.int8] = np.empty((0, 0), dtype=np.int8)
        self._first: Place = np.zeros(2, np.int64)  # of the tile at cells[0, 0]
        self._low = self._end = self._first  # corners of what was rendered, the second excluded
        self._edge = 0  # cells along a tile
        self._cell_m = 0.0
        self._version = 0
        self._snapshot: Grid | None = None

    def render(self, tiles: Iterable[TileUpdate]) -> None:
        self._tiles |= {(tile.iy, tile.ix): tile for tile in tiles}
        if not self._tiles:
            return
        self._cover()
        w, (first_row, first_column) = self._edge, self._first.tolist()
        for (iy, ix), tile in self._tiles.items():
            row, column = (iy - first_row) * w, (ix - first_column) * w
            self._cells[row : row + w, column : column + w] = tile.cells
            self._version = max(self._version, tile.version)
        self._tiles = {}
        self._snapshot = None

    def grid(self) -> Grid | None:
        if self._snapshot is None and self._edge > 0:
            cells = self._rendered().copy()
            cells.setflags(write=False)
            y_min_m, x_min_m = (self._low * (self._edge * self._cell_m)).tolist()
            self._snapshot = Grid(self._version, self._cell_m, x_min_m, y_min_m, cells)
        return self._snapshot

    def _rendered(self) -> npt.NDArray[np.int8]:
        (top, left), (bottom, right) = (
            (corner - self._first) * self._edge for corner in (self._low, self._end)
        )
        return self._cells[top:bottom, left:right]

    def _cover(self) -> None:
        """Make room for the tiles, keeping what is rendered; with room to spare: a long drive copies seldom.

        Raises StorageError when it would be too large.
        """
        if self._edge == 0:
            first = next(iter(self._tiles.values()))
            self._edge, self._cell_m = len(first.cells), first.cell_m
        for tile in self._tiles.values():
            if tile.cells.shape != (self._edge, self._edge) or tile.cell_m != self._cell_m:
                raise ValueError(
                    f"tile {tile.ix}, {tile.iy} is {tile.cells.shape} cells of {tile.cell_m} m; "
                    f"this map has {self._edge} x {self._edge} of {self._cell_m} m"
                )
        places = np.array([*self._tiles, *([self._low, self._end - 1] if self._cells.size else [])])
        low, end = places.min(axis=0), places.max(axis=0) + 1
        height, width = (end - low).tolist()
        if width * height * self._edge**2 > MAX_GRID_CELLS:
            tile_m, cells = self._edge * self._cell_m, width * height * self._edge**2
            raise StorageError(
                f"the map spans {width * tile_m:.0f} x {height * tile_m:.0f} m, {cells} cells; "
                f"one picture holds at most {MAX_GRID_CELLS}: take its tiles, or set a larger mapping.cell_m"
            )
        before = self._rendered(), self._low
        self._low, self._end = low, end
        if (low < self._first).any() or ((end - self._first) * self._edge > self._cells.shape).any():
            spare = np.maximum(MIN_SPARE_TILES, (end - low) // 4)
            self._first = low - spare
            self._cells = np.full((end - low + 2 * spare) * self._edge, UNKNOWN, np.int8)
            rendered, at = before
            row, column = (at - self._first) * self._edge
            self._cells[row : row + rendered.shape[0], column : column + rendered.shape[1]] = rendered


def grid_of_tiles(tiles: Iterable[TileUpdate]) -> Grid:
    """The finest level, which is not empty, as one picture. Raises StorageError beyond MAX_GRID_CELLS."""
    store = TileStore()
    store.update(tiles)
    grid = store.grid()
    assert grid is not None
    return grid


def tiles_of_grid(grid: Grid) -> list[TileUpdate]:
    """A grid as tiles, its cells moved by less than half a cell to where those of tiles lie."""
    column, row = round(grid.x_min_m / grid.cell_m), round(grid.y_min_m / grid.cell_m)
    height, width = grid.cells.shape
    first_ix, first_iy = column // EDGE, row // EDGE
    columns, rows = math.ceil((column + width) / EDGE) - first_ix, math.ceil((row + height) / EDGE) - first_iy
    canvas = np.full((rows * EDGE, columns * EDGE), UNKNOWN, dtype=np.int8)
    low, left = row - first_iy * EDGE, column - first_ix * EDGE
    canvas[low : low + height, left : left + width] = grid.cells
    squares = canvas.reshape(rows, EDGE, columns, EDGE).swapaxes(1, 2)
    known = np.argwhere((squares != UNKNOWN).any(axis=(2, 3))).tolist()
    return [
        TileUpdate(0, first_ix + ix, first_iy + iy, version, grid.cell_m, squares[iy, ix])
        for version, (iy, ix) in enumerate(known, start=1)
    ]
