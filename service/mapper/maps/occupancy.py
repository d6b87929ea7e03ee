"""The published occupancy map, in tiles of 64 cells a side, in the map frame."""

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from pydantic import Field

from drivers.section import Section
from service.geometry.grid import TileRange
from service.geometry.polygons import Cells, cells_along, cells_inside, centres_of, is_inside
from service.geometry.se2 import SE2
from service.kernels.occupancy import (
    GRID_TILE_BITS,
    GRID_TILE_CELLS,
    GRID_TILE_MASK,
    Evidence,
    OccupancyGrid,
    to_per_cent,
    trace_scan,
    write_tiles,
)
from service.kernels.tiles import NO_TILE
from service.mapper.components import (
    AreaToErase,
    Points,
    RenderedMap,
    ScanToRender,
    Standing,
    ToRender,
    WallToRender,
)
from service.mapper.maps.tiles import Layer, TileMap, TilePool, reach_of
from service.outputs import UNKNOWN, Grid, MapperOutput, TileUpdate

OCCUPANCY_POOL_TILES = 131_072  # 1.6 GB of address space, 1.3 km2 at 5 cm; only touched pages take memory
SHOWN_REACH_M = 40.0  # around the vehicle; at 10 cm a cell, at most 640 000 cells


class OccupancyConfig(Section):
    """When a scan is rendered, and how far its beams clear."""

    insert_distance_m: float = Field(default=0.10, gt=0.0)
    insert_turn_rad: float = Field(default=0.08, gt=0.0)
    insert_interval_s: float = Field(default=0.5, gt=0.0)  # also at standstill: people who left are cleared
    free_range_m: float = Field(default=25.0, gt=0.0)  # length up to which beams clear cells


HIT_LOG_ODDS = 1.2  # of an end point: one hit is 77 %, so that thin legs are visible
MISS_LOG_ODDS = 0.5  # of a passing beam: weaker, because beams graze cells of walls they do not meet
MAX_LOG_ODDS = 3.5  # of both signs, 97 %: seven passing beams clear a wall
STEP_LOG_ODDS = 0.05  # so that +-6 fits in a byte
EVIDENCE = Evidence(
    round(HIT_LOG_ODDS / STEP_LOG_ODDS),
    -round(MISS_LOG_ODDS / STEP_LOG_ODDS),
    -round(MAX_LOG_ODDS / STEP_LOG_ODDS),
    round(MAX_LOG_ODDS / STEP_LOG_ODDS),
)
FREE_EVIDENCE = 2 * EVIDENCE.miss  # two misses and no hit
NO_CELLS: Cells = np.zeros((0, 2), np.int64)
RENDERED_AT_ONCE = 2  # older scans rendered with each new one after a correction


class Canvas:
    """Evidence in tiles, and the rendering of scans into them."""

    def __init__(
        self, evidence: Evidence, free_range_m: float, cell_m: float, capacity: int = OCCUPANCY_POOL_TILES
    ) -> None:
        self._evidence = evidence
        self._free_range_m = free_range_m
        self._cell_m = cell_m
        self.pool = TilePool(
            (
                Layer((GRID_TILE_CELLS, GRID_TILE_CELLS), np.int8),
                Layer((GRID_TILE_CELLS, GRID_TILE_CELLS), np.uint16),
                Layer((), np.uint8),
            ),
            capacity,
        )
        self.tiles = TileMap(self.pool)
        self._walls: _CellsByTile = []  # drawn by the operator
        self._scan_number = 0

    def draw(self, xy_base: npt.NDArray[np.float64], sensor_xy_m: tuple[float, float], pose: SE2) -> None:
        if len(xy_base) == 0:
            return
        sensor = np.array(sensor_xy_m)
        reach_m = max(reach_of(xy_base), reach_of(sensor.reshape(1, 2)))
        self.tiles.cover_around((pose.x_m, pose.y_m), reach_m, self._cell_m, GRID_TILE_BITS)
        self._scan_number = self._scan_number % np.iinfo(np.uint16).max + 1
        trace_scan(
            xy_base,
            sensor,
            np.array(pose),
            self.grid(),
            self._evidence,
            self._free_range_m,
            np.uint16(self._scan_number),
        )

    def render_again(self, items: Iterable[ToRender]) -> None:
        for item in items:
            match item:
                case ScanToRender():
                    self.draw(item.xy_base.astype(np.float64), item.sensor_xy_m, item.pose_map_base)
                case AreaToErase():
                    inside = cells_inside(item.corners_map, self._cell_m)
                    self._fill(_by_tile(inside), self._evidence.least if item.is_free else 0)
                case WallToRender():
                    self.set_walls(np.concatenate((self.wall_cells, cells_of_wall(item, self._cell_m))))

    @property
    def wall_cells(self) -> Cells:
        """Cells of walls drawn by the operator."""
        return np.concatenate((NO_CELLS, *(cells for _, _, cells in self._walls)))

    def set_walls(self, cells: Cells) -> None:
        """Make exactly these cells walls, whatever beams measure from now on."""
        self._walls = _by_tile(cells)

    def restore_walls(self) -> None:
        """Restore walls that beams have weakened."""
        self._fill(self._walls, self._evidence.most)

    def _fill(self, cells_by_tile: "_CellsByTile", value: int) -> None:
        for row, column, cells in cells_by_tile:
            self.tiles.cover(TileRange(row, column, row, column))
            slot = self._slot_of(row, column)
            evidence, _, changed = self.pool.arrays
            at = slot, cells[:, 0] & GRID_TILE_MASK, cells[:, 1] & GRID_TILE_MASK
            if (evidence[at] != value).any():
                evidence[at] = value
                changed[slot] = 1

    def _slot_of(self, row: int, column: int) -> int:
        place = (row - int(self.tiles.origin[0]), column - int(self.tiles.origin[1]))
        if (slot := int(self.tiles.slots[place])) != NO_TILE:
            return slot
        slot, used_before = self.tiles.take(row, column)
        if used_before:
            for layer in self.pool.arrays[:2]:
                layer[slot] = 0
        return slot

    def rendered_map(self) -> RenderedMap:
        """A copy of the map."""
        tiles = np.array(self.tiles.tiles(), np.int64).reshape(-1, 3)
        # Contiguous, as from another process: else the kernel is compiled twice.
        row, column = np.ascontiguousarray(tiles[:, 0]), np.ascontiguousarray(tiles[:, 1])
        evidence = self.pool.arrays[0][tiles[:, 2]]
        return RenderedMap(row, column, evidence, self.wall_cells)  # type: ignore[arg-type]

    def replace_by(self, rendered_map: RenderedMap) -> None:
        if len(rendered_map.tile_row):
            self.tiles.cover(
                TileRange(
                    int(rendered_map.tile_row.min()),
                    int(rendered_map.tile_column.min()),
                    int(rendered_map.tile_row.max()),
                    int(rendered_map.tile_column.max()),
                )
            )
        write_tiles(rendered_map.tile_row, rendered_map.tile_column, rendered_map.evidence, self.grid())
        self.set_walls(rendered_map.wall_cells)
        self.restore_walls()

    def replace_part(self, part: RenderedMap) -> None:
        """Replace only the cells of the part; no tile is created where both are empty."""
        assert part.is_part is not None
        there = {(row, column) for row, column, _ in self.tiles.tiles()}
        for row, column, evidence, is_part in zip(
            part.tile_row.tolist(), part.tile_column.tolist(), part.evidence, part.is_part, strict=True
        ):
            if (row, column) not in there and not evidence[is_part].any():
                continue
            self.tiles.cover(TileRange(row, column, row, column))
            slot = self._slot_of(row, column)
            now, _, changed = self.pool.arrays
            if (now[slot][is_part] != evidence[is_part]).any():
                now[slot][is_part] = evidence[is_part]
                changed[slot] = 1
        self.set_walls(part.wall_cells)
        self.restore_walls()

    def grid(self) -> OccupancyGrid:
        evidence, touched, changed = self.pool.arrays
        return OccupancyGrid(self.tiles.index(), evidence, touched, changed, self._cell_m)  # type: ignore[arg-type]


_CellsByTile = list[tuple[int, int, Cells]]  # row and column of the tile, and cells in it


def cells_of_wall(wall: WallToRender, cell_m: float) -> Cells:
    """(K, 2) row and column of the cells of a wall."""
    cells = cells_along(wall.corners_map, cell_m)
    for corners in wall.erased_map:
        cells = cells[~is_inside(centres_of(cells, cell_m), corners)]
    return cells


def _by_tile(cells: Cells) -> _CellsByTile:
    cells = np.unique(cells, axis=0)
    tiles, tile_of = np.unique(cells >> GRID_TILE_BITS, axis=0, return_inverse=True)
    return [(row, column, cells[tile_of.ravel() == k]) for k, (row, column) in enumerate(tiles.tolist())]


@dataclass(frozen=True, slots=True)
class OccupancyRenderer:
    """MapRenderer of OccupancyTiles."""

    free_range_m: float
    cell_m: float

    def canvas(self) -> Canvas:
        return Canvas(EVIDENCE, self.free_range_m, self.cell_m)

    def render(self, items: Iterable[ToRender]) -> RenderedMap:
        canvas = self.canvas()
        canvas.render_again(items)
        canvas.restore_walls()
        return canvas.rendered_map()

    def render_part(self, items: Iterable[ToRender], corners_map: npt.NDArray[np.float64]) -> RenderedMap:
        rendered = self.render(items)
        cells = cells_inside(corners_map, self.cell_m)
        low = cells.min(axis=0) >> GRID_TILE_BITS
        rows, columns = (cells.max(axis=0) >> GRID_TILE_BITS) - low + 1
        inside = np.zeros((rows * GRID_TILE_CELLS, columns * GRID_TILE_CELLS), np.bool_)
        inside[tuple((cells - (low << GRID_TILE_BITS)).T)] = True
        by_tile = inside.reshape(rows, GRID_TILE_CELLS, columns, GRID_TILE_CELLS).swapaxes(1, 2)
        row, column = np.nonzero(by_tile.any(axis=(2, 3)))
        evidence = np.zeros((rows, columns, GRID_TILE_CELLS, GRID_TILE_CELLS), np.int8)
        at = np.column_stack((rendered.tile_row, rendered.tile_column)) - low
        is_near = ((at >= 0) & (at < (rows, columns))).all(axis=1)
        evidence[tuple(at[is_near].T)] = rendered.evidence[is_near]
        return RenderedMap(
            row + low[0], column + low[1], evidence[row, column], rendered.wall_cells, by_tile[row, column]
        )


def rendered_of(tiles: Sequence[TileUpdate], walls: Iterable[WallToRender] = ()) -> RenderedMap:
    """Stored tiles of the finest level as a map to continue in, with the least evidence that renders the
    same.

    walls   drawn by the operator
    Raises ValueError for tiles of another size.
    """
    fine = [tile for tile in tiles if tile.level == 0]
    if any(tile.cells.shape != (GRID_TILE_CELLS, GRID_TILE_CELLS) for tile in fine):
        raise ValueError(f"tiles of {fine[0].cells.shape} cells; this map has {GRID_TILE_CELLS} a side")
    most = EVIDENCE.most
    steps = np.arange(-most, most + 1)
    per_cent = np.floor(100.0 / (1.0 + np.exp(-STEP_LOG_ODDS * steps)) + 0.5).astype(np.int64)
    evidence_of = np.zeros(101, np.int8)
    for step, shown in sorted(zip(steps.tolist(), per_cent.tolist(), strict=True), key=lambda s: -abs(s[0])):
        if step:
            evidence_of[shown] = step
    cells = np.array([tile.cells for tile in fine], np.int8).reshape(-1, GRID_TILE_CELLS, GRID_TILE_CELLS)
    evidence = np.where(cells < 0, 0, evidence_of[np.maximum(cells, 0)]).astype(np.int8)
    row = np.array([tile.iy for tile in fine], np.int64)
    column = np.array([tile.ix for tile in fine], np.int64)
    along = [cells_of_wall(wall, fine[0].cell_m) for wall in walls] if fine else []
    return RenderedMap(row, column, evidence, np.concatenate((NO_CELLS, *along)))


class OccupancyTiles:
    """FreeSpaceMap by log-odds."""

    def __init__(self, config: OccupancyConfig, cell_m: float) -> None:
        self._config = config
        self._cell_m = cell_m
        self.renderer = OccupancyRenderer(config.free_range_m, cell_m)
        self._canvas = self.renderer.canvas()
        self._shown: dict[int, npt.NDArray[np.int8]] = {}  # by slot: the cells as last published
        self._version = 0
        self._to_render: deque[ScanToRender] = deque()
        self._last: tuple[SE2, int] | None = None

    @property
    def tile_count(self) -> int:
        return self._canvas.pool.used_count

    def insert(self, points: Points, pose_map_base: SE2) -> None:
        if self._to_render:
            self._canvas.render_again(
                [self._to_render.popleft() for _ in range(min(RENDERED_AT_ONCE, len(self._to_render)))]
            )
        config, stamp_ns = self._config, points.scan.stamp_ns
        if self._last is not None:
            last, last_ns = self._last
            is_step = pose_map_base.is_step_from(last, config.insert_distance_m, config.insert_turn_rad)
            if not is_step and (stamp_ns - last_ns) * 1e-9 < config.insert_interval_s:
                return
        if len(points.xy_base) == 0:
            return
        self._last = (pose_map_base, stamp_ns)
        sensor = points.sensor_base
        self._canvas.draw(points.xy_base, (sensor.x_m, sensor.y_m), pose_map_base)

    def replace_by(self, rendered_map: RenderedMap, since: Sequence[ScanToRender]) -> None:
        """Replace the map; tiles that are not in it become unknown, only changed tiles get a new version.

        The scans `since` are rendered with the next scans, a few with each, so that none is delayed.
        """
        if rendered_map.is_part is not None:
            self._canvas.render_again(self._to_render)  # older than the part
            self._canvas.replace_part(rendered_map)
        else:
            self._canvas.replace_by(rendered_map)
        self._to_render = deque(since)

    def changed_tiles(self, most: int | None = None) -> list[TileUpdate]:
        self._canvas.restore_walls()
        evidence, _touched, changed = self._canvas.pool.arrays
        updates: list[TileUpdate] = []
        for row, column, slot in self._canvas.tiles.tiles(changed):
            if len(updates) == most:
                break
            changed[slot] = 0
            before = self._shown.get(slot)
            cells = np.full((GRID_TILE_CELLS,) * 2, UNKNOWN, np.int8) if before is None else before.copy()
            if not to_per_cent(evidence[slot], STEP_LOG_ODDS, cells):
                continue
            cells.setflags(write=False)
            self._shown[slot] = cells
            self._version += 1
            updates.append(TileUpdate(0, column, row, self._version, self._cell_m, cells))
        return updates

    def tiles(self) -> list[TileUpdate]:
        """All tiles, as changed_tiles returns them on its first call, without its effects.

        Versions are serial numbers.
        """
        self._canvas.restore_walls()
        evidence, _touched, _changed = self._canvas.pool.arrays
        tiles: list[TileUpdate] = []
        for row, column, slot in self._canvas.tiles.tiles():
            cells = np.full((GRID_TILE_CELLS,) * 2, UNKNOWN, np.int8)
            if to_per_cent(evidence[slot], STEP_LOG_ODDS, cells):
                cells.setflags(write=False)
                tiles.append(TileUpdate(0, column, row, len(tiles) + 1, self._cell_m, cells))
        return tiles


def draw_standing(standing: Standing, newest: MapperOutput) -> Grid | None:
    """A grid of the static score around the newest pose, per cent of the time after which it is full.

    Free cells are UNKNOWN. None where nothing is occupied within reach.
    """
    c, s = np.cos(newest.pose_map_odom.theta_rad), np.sin(newest.pose_map_odom.theta_rad)
    x_m = newest.pose_map_odom.x_m + c * standing.xy_odom[:, 0] - s * standing.xy_odom[:, 1]
    y_m = newest.pose_map_odom.y_m + s * standing.xy_odom[:, 0] + c * standing.xy_odom[:, 1]
    vehicle = newest.pose_map_base
    near = (np.abs(x_m - vehicle.x_m) < SHOWN_REACH_M) & (np.abs(y_m - vehicle.y_m) < SHOWN_REACH_M)
    if not near.any():
        return None
    column = np.floor(x_m[near] / standing.cell_m).astype(np.int64)
    row = np.floor(y_m[near] / standing.cell_m).astype(np.int64)
    first_column, first_row = int(column.min()), int(row.min())
    cells = np.full((int(row.max()) - first_row + 1, int(column.max()) - first_column + 1), UNKNOWN, np.int8)
    percent = np.maximum(np.rint(100.0 * standing.share[near]), 1.0).astype(np.int8)
    np.maximum.at(cells, (row - first_row, column - first_column), percent)
    cells.setflags(write=False)
    return Grid(0, standing.cell_m, first_column * standing.cell_m, first_row * standing.cell_m, cells)
