"""Tiles of a stored map in which a person has erased an area or added a wall; all other cells stay."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from service.geometry.polygons import Cells, cells_along, cells_inside
from service.geometry.poses import Floats
from service.outputs import UNKNOWN, TileUpdate

_NO_CELLS: Cells = np.empty((0, 2), np.int64)


def with_area(
    tiles: Sequence[TileUpdate], corners_map: Floats, value: int, source: Sequence[TileUpdate] = ()
) -> tuple[list[TileUpdate], int]:
    """With `value` within a polygon (C, 2) m, in the tiles that there are; and how many cells of the finest
    level changed. Each tile that changed gets a new version.

    source   tiles whose cells are used in place of `value`
    """
    cells = {cell_m: cells_inside(corners_map, cell_m) for cell_m in _sizes(tiles)}
    return _filled(tiles, cells, value, source)


def with_line(tiles: Sequence[TileUpdate], corners_map: Floats, value: int) -> tuple[list[TileUpdate], int]:
    """With `value` along a line through (C, 2) m, also where no tile was; else as with_area."""
    cells = {cell_m: cells_along(corners_map, cell_m) for cell_m in _sizes(tiles)}
    return _filled(_covering(tiles, cells), cells, value)


def with_cells(
    tiles: Sequence[TileUpdate], cells: Cells, cell_m: float, source: Sequence[TileUpdate]
) -> tuple[list[TileUpdate], int]:
    """With cells of one size, each in a tile of `source`, as they are there, also where no tile was; else as
    with_area.
    """
    return _filled(_covering(tiles, {cell_m: cells}), {cell_m: cells}, UNKNOWN, source)


def _sizes(tiles: Sequence[TileUpdate]) -> set[float]:
    return {tile.cell_m for tile in tiles}


def _filled(
    tiles: Sequence[TileUpdate],
    cells_by_size: dict[float, Cells],
    value: int,
    source: Sequence[TileUpdate] = (),
) -> tuple[list[TileUpdate], int]:
    by_place = {(tile.level, tile.ix, tile.iy): tile.cells for tile in source}
    version = max(tile.version for tile in tiles)
    filled, count = [], 0
    for tile in tiles:
        edge, cells = len(tile.cells), cells_by_size.get(tile.cell_m, _NO_CELLS)
        row, column = (cells[(cells // edge == (tile.iy, tile.ix)).all(axis=1)] % edge).T
        shown = by_place.get((tile.level, tile.ix, tile.iy))
        values = value if shown is None else shown[row, column]
        changed = tile.cells[row, column] != values
        if not changed.any():
            filled.append(tile)
            continue
        new = tile.cells.copy()
        new[row, column] = values
        new.setflags(write=False)
        version += 1
        filled.append(replace(tile, version=version, cells=new))
        count += int(changed.sum()) if tile.level == 0 else 0
    return filled, count


def _covering(tiles: Sequence[TileUpdate], cells_by_size: dict[float, Cells]) -> list[TileUpdate]:
    """These tiles, and unknown ones where cells have none."""
    there = {(tile.level, tile.ix, tile.iy) for tile in tiles}
    more = []
    for level, cell_m, edge in sorted({(tile.level, tile.cell_m, len(tile.cells)) for tile in tiles}):
        unknown = np.broadcast_to(np.int8(UNKNOWN), (edge, edge))
        for iy, ix in np.unique(cells_by_size.get(cell_m, _NO_CELLS) // edge, axis=0).tolist():
            if (level, ix, iy) not in there:
                more.append(TileUpdate(level, ix, iy, 0, cell_m, unknown))
    return [*tiles, *more]
