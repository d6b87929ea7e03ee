"""What is shown and driven on: occupancy in tiles of 64 cells a side, in the map frame."""

import math

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

from service.geometry.grid import tiles_of
from service.geometry.se2 import SE2, wrap_angle
from service.kernels.occupancy import (
    TILE_BITS,
    TILE_CELLS,
    Evidence,
    OccupancyGrid,
    to_per_cent,
    trace_scan,
)
from service.mapper.maps.tiles import Layer, TileMap, TilePool, reach_of
from service.mapper.stages import Points
from service.outputs import UNKNOWN, TileUpdate

POOL_TILES = 131_072  # 1.6 GB of address space, 1.3 km2 at 5 cm; only what is seen costs memory


class OccupancyConfig(BaseModel):
    """When a scan is drawn, and how much each beam says."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    insert_distance_m: float = Field(default=0.10, gt=0.0)
    insert_turn_rad: float = Field(default=0.08, gt=0.0)
    insert_interval_s: float = Field(default=0.5, gt=0.0)  # also when standing: who walked away is cleared
    free_range_m: float = Field(default=25.0, gt=0.0)  # beams clear cells up to here
    hit_log_odds: float = Field(default=1.2, gt=0.0)
    miss_log_odds: float = Field(default=0.5, gt=0.0)
    most_log_odds: float = Field(default=3.5, gt=0.0, le=6.0)  # of both signs; 3.5 is 97 %


STEP_LOG_ODDS = 0.05  # so that +-6 fits in a byte


def in_steps(log_odds: float) -> int:
    return max(1, round(log_odds / STEP_LOG_ODDS))


class OccupancyTiles:
    """FreeSpaceMap by log-odds."""

    def __init__(self, config: OccupancyConfig, cell_m: float) -> None:
        self._config = config
        self._cell_m = cell_m
        most = in_steps(config.most_log_odds)
        self._evidence = Evidence(in_steps(config.hit_log_odds), -in_steps(config.miss_log_odds), -most, most)
        self._pool = TilePool(
            (
                Layer((TILE_CELLS, TILE_CELLS), np.int8),
                Layer((TILE_CELLS, TILE_CELLS), np.uint16),
                Layer((), np.uint8),
            ),
            POOL_TILES,
        )
        self._tiles = TileMap(self._pool)
        self._shown: dict[int, npt.NDArray[np.int8]] = {}  # by slot: the cells as last handed out
        self._version = 0
        self._scan_number = 0
        self._last: tuple[SE2, int] | None = None

    @property
    def tile_count(self) -> int:
        return self._pool.used_count

    def insert(self, points: Points, pose_map_base: SE2) -> None:
        stamp_ns = points.scan.stamp_ns
        if len(points.xy_base) == 0 or not self._is_due(pose_map_base, stamp_ns):
            return
        self._last = (pose_map_base, stamp_ns)
        pose = np.array([pose_map_base.x_m, pose_map_base.y_m, pose_map_base.theta_rad])
        sensor_xy_m = np.array([points.sensor_base.x_m, points.sensor_base.y_m])
        reach_m = max(reach_of(points.xy_base), reach_of(sensor_xy_m.reshape(1, 2)))
        self._tiles.cover(
            tiles_of(
                (pose_map_base.x_m - reach_m, pose_map_base.y_m - reach_m),
                (pose_map_base.x_m + reach_m, pose_map_base.y_m + reach_m),
                self._cell_m,
                TILE_BITS,
                margin_cells=1,
            )
        )
        self._scan_number = self._scan_number % 65_535 + 1
        trace_scan(
            points.xy_base,
            sensor_xy_m,
            pose,
            self._grid(),
            self._evidence,
            self._config.free_range_m,
            np.uint16(self._scan_number),
        )

    def changed_tiles(self) -> list[TileUpdate]:
        evidence, _touched, changed = self._pool.arrays
        updates = []
        for row, column, slot in self._tiles.tiles():
            if not changed[slot]:
                continue
            changed[slot] = 0
            before = self._shown.get(slot)
            cells = np.full((TILE_CELLS,) * 2, UNKNOWN, np.int8) if before is None else before.copy()
            if not to_per_cent(evidence[slot], STEP_LOG_ODDS, cells):
                continue
            cells.setflags(write=False)
            self._shown[slot] = cells
            self._version += 1
            updates.append(TileUpdate(0, column, row, self._version, self._cell_m, cells))
        return updates

    def _grid(self) -> OccupancyGrid:
        evidence, touched, changed = self._pool.arrays
        return OccupancyGrid(self._tiles.index(), evidence, touched, changed, self._cell_m)  # type: ignore[arg-type]

    def _is_due(self, pose: SE2, stamp_ns: int) -> bool:
        if self._last is None:
            return True
        last, last_ns = self._last
        config = self._config
        return (
            math.hypot(pose.x_m - last.x_m, pose.y_m - last.y_m) >= config.insert_distance_m
            or abs(wrap_angle(pose.theta_rad - last.theta_rad)) >= config.insert_turn_rad
            or (stamp_ns - last_ns) * 1e-9 >= config.insert_interval_s
        )
