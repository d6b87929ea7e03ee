"""What changed at a site from session to session: cells that one saw occupied and a later one free, or the
reverse; and whether so much of them that the session is of another place.

It compares what each session saw by itself at the solved poses, so the error of the poses counts, and the
sensor's. A wall that both saw within NEAR_CELLS of each other is the same one.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import numpy.typing as npt

from drivers.counted import counted
from service.geometry.groups import groups_of
from service.geometry.polygons import Cells
from service.kernels.occupancy import GRID_TILE_BITS, GRID_TILE_CELLS, GRID_TILE_MASK
from service.mapper.by_hand import ByHand
from service.mapper.components import RenderedMap
from service.mapper.graph.loops.stored_graph import to_render
from service.mapper.graph.model.keyframe_list import KeyframeList
from service.mapper.maps.occupancy import EVIDENCE, NO_CELLS, OccupancyRenderer
from service.mapper.saved_graph import SavedGraph

FREE_RANGE_M = 10.0  # farther away a beam along a wall passes cells of the wall between two of its points
FREE = 4 * EVIDENCE.miss  # net, of one session: 12 %
OCCUPIED = 2 * EVIDENCE.hit  # 92 %
NEAR_CELLS = 2
LINK_CELLS = 5  # the faces of one thing lie so near to each other
MIN_CELLS = 8  # of a changed place: 0.4 m of a wall
PLACE_M, MIN_CELLS_OF_PLACE = 4.0, 20  # walls that both saw there make it one to judge by
# Share of the places in which walls are gone, or new. Parts of fr079 and intel, mapped by themselves: 0 to
# 11 %, of one kind; two floors of one plan: 25 to 31 % gone and 22 to 30 % new.
CHANGED_SHARE, OTHER_SHARE = 0.05, 0.25
MIN_LOG_ODDS = math.log(1000.0)  # that it is another place
_ROW = 1 << 32  # of the key of a cell: row * _ROW + column
Tile = tuple[int, int]  # row and column
Tiles = dict[Tile, npt.NDArray[np.int8]]  # evidence
_UNSEEN = np.zeros((1, GRID_TILE_CELLS, GRID_TILE_CELLS), np.int8)
_AROUND = [*product((-1, 0, 1), repeat=2)]  # of a tile: it and its neighbours


def seen_by(graph: SavedGraph, cell_m: float) -> RenderedMap:
    """Map of the key frames of one session, without edits by hand."""
    keyframes = KeyframeList(replace(graph, by_hand=ByHand()))
    return OccupancyRenderer(FREE_RANGE_M, cell_m).render(to_render(keyframes, np.ones(len(graph), np.bool_)))


@dataclass(frozen=True, slots=True, eq=False)
class Change:
    """A place where an object is gone, or is now where it was free.

    cells          (K, 2) row and column
    is_new         something stands there now
    seen           the first and the last session that saw it as it was
    session        the first that saw it changed
    """

    cells: Cells
    is_new: bool
    seen: tuple[int, int]
    session: int


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """A session against the newest state that those before saw, by the places of PLACE_M that both saw.

    gone, new   (K, 2) the cells that changed, of each changed place
    """

    places: int
    places_gone: int
    places_new: int
    gone: list[Cells]
    new: list[Cells]

    @property
    def counts(self) -> dict[str, int]:
        return {"places": self.places, "gone": self.places_gone, "new": self.places_new}


def log_odds_elsewhere(places: int, gone: int, new: int) -> float:
    """Log-odds that a session is of another place, against that objects were moved, by its Comparison.

    Another floor of the plan lacks walls and has others; doors that were shut, or a store that was emptied,
    are of one kind. So the kind counts of which there is less.
    """
    changed = min(gone, new)
    log_odds = changed * math.log(OTHER_SHARE / CHANGED_SHARE)
    return log_odds + (places - changed) * math.log((1.0 - OTHER_SHARE) / (1.0 - CHANGED_SHARE))


def in_words(places: int, gone: int, new: int) -> str:
    return (
        f"of {counted(places, 'place')} of {PLACE_M:.0f} m that it and earlier sessions saw, {gone} lack "
        f"walls or things that stood there, and {new} have some where it was free"
    )


class Layers:
    """The newest state of each cell, from which session to which it was seen, and what it was before.

    Sessions are numbers, given in the order of their dates.
    """

    def __init__(self, cell_m: float) -> None:
        self.changes: list[Change] = []
        self._place_cells = round(PLACE_M / cell_m)
        self._number: dict[Tile, int] = {}  # of each tile in the arrays, which have room for more
        self._evidence = _UNSEEN[:0]  # of the newest session that is sure
        self._first, self._last = np.zeros((2, *self._evidence.shape), np.int16)  # sessions that saw it so

    def compare(self, seen: RenderedMap) -> Comparison:
        if not len(seen.evidence):
            return Comparison(0, 0, 0, [], [])
        tiles = np.column_stack((seen.tile_row, seen.tile_column))
        around = {(row + i, column + j) for row, column in tiles.tolist() for i, j in _AROUND}
        there = sorted(around & self._number.keys())
        number = [self._number[tile] for tile in there]
        ends = tiles.min(axis=0), tiles.max(axis=0)
        stood = _Grid(np.array(there, np.int64).reshape(-1, 2), self._evidence[number], *ends)
        stands = _Grid(tiles, seen.evidence, *ends)
        gone, new = _changed(stood, stands), _changed(stands, stood)
        common = self._places([stood.walls[stands.is_near(stood.walls, OCCUPIED)]], MIN_CELLS_OF_PLACE)
        gone_at, new_at = self._places(gone, MIN_CELLS), self._places(new, MIN_CELLS)
        return Comparison(len(common | gone_at | new_at), len(gone_at), len(new_at), gone, new)

    def add(self, session: int, seen: RenderedMap, compared: Comparison) -> None:
        """compared   of this session, now"""
        for is_new, groups in ((False, compared.gone), (True, compared.new)):
            for cells in groups:
                at = tuple(np.array([(self._number[tile], *in_tile) for tile, *in_tile in _at(cells)]).T)
                span = int(self._first[at].min()), int(self._last[at].max())
                self.changes.append(Change(cells, is_new, span, session))
        number, evidence = self._numbers_of(seen, session), seen.evidence
        kept, first, last = (one[number] for one in (self._evidence, self._first, self._last))
        is_sure = (evidence <= FREE) | (evidence >= OCCUPIED)
        np.copyto(first, session, where=is_sure & (np.sign(kept) != np.sign(evidence)))
        np.copyto(last, session, where=is_sure)
        np.copyto(kept, evidence, where=is_sure | (kept == 0))
        self._evidence[number], self._first[number], self._last[number] = kept, first, last

    def _numbers_of(self, seen: RenderedMap, session: int) -> list[int]:
        """Numbers of its tiles; of new ones the state is of this session."""
        count, numbers = len(self._number), self._number
        tiles = zip(seen.tile_row.tolist(), seen.tile_column.tolist(), strict=True)
        number = [numbers.setdefault(tile, len(numbers)) for tile in tiles]
        if len(numbers) > len(self._evidence):
            more = np.zeros((len(numbers), *_UNSEEN.shape[1:]), np.int16)
            self._evidence = np.concatenate((self._evidence, more.astype(np.int8)))
            self._first, self._last = (np.concatenate((one, more)) for one in (self._first, self._last))
        self._first[count:] = self._last[count:] = session
        return number

    def newest(self, shown: RenderedMap) -> RenderedMap:
        """A map rendered from all sessions with the newest state in the cells that changed: older sessions
        may have been rendered last, or more often.
        """
        evidence = shown.evidence.copy()
        by_tile = _tiles(replace(shown, evidence=evidence))
        for change in self.changes:
            for tile, row, column in _at(change.cells):
                if tile in by_tile:
                    by_tile[tile][row, column] = self._evidence[self._number[tile], row, column]
        return replace(shown, evidence=evidence)

    def _places(self, groups: Sequence[Cells], least: int) -> set[int]:
        """Keys of the places that have so many of the cells."""
        places, counts = np.unique(
            _keys_of(np.concatenate([NO_CELLS, *groups]) // self._place_cells), return_counts=True
        )
        return set(places[counts >= least].tolist())


class _Grid:
    """Evidence in tiles, looked up by cells from a tile before `low` to a tile behind `high`, and NEAR_CELLS
    beside them.

    walls   (N, 2) the occupied cells
    """

    def __init__(
        self,
        tiles: Cells,
        evidence: npt.NDArray[np.int8],
        low: npt.NDArray[np.int64],
        high: npt.NDArray[np.int64],
    ) -> None:
        """tiles: (T, 2) row and column of each"""
        self._first = low - 2
        self._number = np.zeros(high + 3 - self._first, np.int64)  # 0: no tile
        self._rows, self._columns = (tiles - self._first).T
        self._number[self._rows, self._columns] = np.arange(1, len(tiles) + 1)
        self._evidence = np.concatenate((_UNSEEN, evidence))
        tile, in_tile = np.divmod(np.flatnonzero(self._evidence >= OCCUPIED), GRID_TILE_CELLS**2)
        row_column = np.column_stack(np.divmod(in_tile, GRID_TILE_CELLS))
        self.walls: Cells = (tiles[tile - 1] << GRID_TILE_BITS) + row_column

    def at(self, cells: Cells) -> npt.NDArray[np.int8]:
        """(N,) evidence of cells (N, 2); 0 where nothing was seen."""
        number = self._number[tuple(((cells >> GRID_TILE_BITS) - self._first).T)]
        row, column = (cells & GRID_TILE_MASK).T
        at = (number * GRID_TILE_CELLS + row) * GRID_TILE_CELLS + column
        evidence: npt.NDArray[np.int8] = self._evidence.take(at)
        return evidence

    def is_near(self, cells: Cells, least: int) -> npt.NDArray[np.bool_]:
        """(N,) of cells (N, 2), whether there is such evidence within NEAR_CELLS."""
        tile_rows, tile_columns = self._number.shape
        bits = np.zeros((tile_rows, GRID_TILE_CELLS, tile_columns), np.uint64)  # of the 64 cells of a row
        is_there = np.packbits(self._evidence[1:] >= least, axis=-1, bitorder="little").view("<u8")
        bits[self._rows, :, self._columns] = is_there[:, :, 0]
        bits = bits.reshape(-1, tile_columns)
        for _ in range(NEAR_CELLS):
            wide = bits | bits << 1 | bits >> 1
            wide[:, 1:] |= bits[:, :-1] >> 63
            wide[:, :-1] |= bits[:, 1:] << 63
            bits = wide.copy()
            bits[1:] |= wide[:-1]
            bits[:-1] |= wide[1:]
        row, column = (cells - (self._first << GRID_TILE_BITS)).T
        in_tile = (column & GRID_TILE_MASK).astype(np.uint64)
        near: npt.NDArray[np.bool_] = (bits[row, column >> GRID_TILE_BITS] >> in_tile & 1).astype(np.bool_)
        return near


def _changed(stood: _Grid, free: _Grid) -> list[Cells]:
    """Groups of cells that are occupied in the one and free in the other, which saw nothing near."""
    cells = stood.walls[free.at(stood.walls) <= FREE]
    cells = cells[~free.is_near(cells, 1)]
    for step in _steps(1):  # a beam along a face passes its cells, too; but it does not see what is behind
        cells = cells[free.at(cells + step) < 0]
    keys = np.sort(_keys_of(cells))
    pairs = [np.empty((0, 2), np.int64)]
    for key in _keys_of(_steps(LINK_CELLS)) if len(keys) else ():
        k = np.searchsorted(keys, keys + key).clip(max=len(keys) - 1)
        linked = np.flatnonzero(keys[k] == keys + key)
        pairs.append(np.column_stack((linked, k[linked])))
    group = groups_of(len(keys), np.concatenate(pairs))
    large = np.flatnonzero(np.bincount(group) >= MIN_CELLS)
    return [_cells_of(keys[group == one]) for one in large]


def _steps(cells: int) -> Cells:
    """From a cell to those so near to it in rows and in columns, the nearest first, and to itself."""
    steps = np.array(list(product(range(-cells, cells + 1), repeat=2)))
    return steps[np.argsort((steps**2).sum(axis=1), kind="stable")]


def _keys_of(cells: Cells) -> npt.NDArray[np.int64]:
    """(N,) rising by row, then by column."""
    return cells[:, 0] * _ROW + cells[:, 1]


def _cells_of(keys: npt.NDArray[np.int64]) -> Cells:
    row = (keys + _ROW // 2) // _ROW
    return np.column_stack((row, keys - row * _ROW))


def _at(cells: Cells) -> Iterator[tuple[Tile, int, int]]:
    """Tile of each cell, and row and column in it."""
    for row, column in cells.tolist():
        tile_row, row_in_tile = divmod(row, GRID_TILE_CELLS)
        tile_column, column_in_tile = divmod(column, GRID_TILE_CELLS)
        yield (tile_row, tile_column), row_in_tile, column_in_tile


def _tiles(seen: RenderedMap) -> Tiles:
    tiles = zip(seen.tile_row.tolist(), seen.tile_column.tolist(), strict=True)
    return dict(zip(tiles, seen.evidence, strict=True))
