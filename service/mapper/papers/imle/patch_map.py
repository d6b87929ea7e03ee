"""A likelihood map in patches: those near the vehicle in memory, the others in a store.

A patch has two layers, a fine one to match on and a coarse one to begin with, one byte a cell. Cells are
never cleared.
"""

import math
from collections.abc import Iterable
from typing import Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from drivers.section import Section
from service.geometry.grid import TileRange
from service.geometry.poses import moved_by
from service.geometry.se2 import SE2
from service.kernels.likelihood_search import LikelihoodLayer
from service.kernels.line_likelihood import mark_patches, rasterise_scan, smooth_lines
from service.mapper.components import MapChange, Match, Overlap, Points
from service.mapper.maps.known_ground import KnownGround
from service.mapper.maps.tiles import Layer, TileMap, TilePool
from service.mapper.patch_store import NewPatchStore, PatchKey

Array = npt.NDArray[np.float64]

# Tang et al. 2014, section 2.3: background, the two rings and the hit, from outside to inside.
BACKGROUND, OUTER, INNER, HIT = 0.1, 0.3, 0.6, 0.9
HIT_CODE = {"product": 250, "mean": 8}  # 8 is 0.8 in tenths, exactly; with 250, ln 3 is exact, ln 6 to 0.1 %


class PatchMapConfig(Section):
    """How the map is divided and rendered, and how much of it is kept in memory."""

    cell_m: float = Field(default=0.01, gt=0.0)
    insert_distance_m: float = Field(default=0.2, ge=0.0)  # a scan is inserted after this path length,
    insert_turn_rad: float = Field(default=0.1, ge=0.0)  # ... or rotation
    coarse_cells: int = Field(default=5, ge=2)  # fine cells along the edge of a coarse one
    patch_cells: int = Field(default=1000, ge=20)  # fine cells along the edge of a patch
    ring_cells: int = Field(default=4, ge=1, le=10)  # width of each of the two rings on the fine layer
    # Neighbouring points closer than this are joined by a line.
    join_m: float = Field(default=0.15, ge=0.0)
    smooth_m: float = Field(default=0.3, ge=0.0)  # half width of the mean along a line
    join_steps: float = Field(default=20.0, ge=0.0)  # added to join_m, in arcs between beams
    score: Literal["product", "mean"] = "product"  # of the likelihoods of the points
    resident_patches: int = Field(default=64, ge=16)  # a patch of 1000 cells a side takes 1.04 MB
    ahead_m: float = Field(default=5.0, ge=0.0)  # patches within this distance of the scan are prefetched

    @model_validator(mode="after")
    def _whole(self) -> "PatchMapConfig":
        if self.patch_cells % self.coarse_cells:
            raise ValueError(
                f"a patch of {self.patch_cells} cells cannot be cut into cells of {self.coarse_cells}; "
                "patch_cells must be a multiple of coarse_cells"
            )
        if self.ahead_m > self.patch_m / 2:
            raise ValueError(f"ahead_m {self.ahead_m:g} is more than half a patch ({self.patch_m:g} m)")
        return self

    @property
    def patch_m(self) -> float:
        return self.cell_m * self.patch_cells

    @property
    def coarse_cell_m(self) -> float:
        return self.cell_m * self.coarse_cells


class PatchMap:
    """LocalMap, in the odom frame. `fine` and `coarse` are valid after `prepare`."""

    def __init__(self, config: PatchMapConfig, new_store: NewPatchStore) -> None:
        self.config = config
        self._new_store = new_store
        code = HIT_CODE[config.score]
        self._offset, self._scale, full = BACKGROUND, 0.1, HIT - BACKGROUND
        values = [HIT - BACKGROUND, INNER - BACKGROUND, OUTER - BACKGROUND]
        if config.score == "product":
            self._offset, full = math.log(BACKGROUND), math.log(HIT / BACKGROUND)
            self._scale = full / code
            values = [math.log(level / BACKGROUND) for level in (HIT, INNER, OUTER)]
        self.levels = np.array([round(code * value / full) for value in values], np.uint8)

        self.start_over()

    def start_over(self) -> None:
        config = self.config
        self.is_empty = True
        self._last: SE2 | None = None  # pose of the last inserted scan
        self._store = self._new_store()
        coarse = config.patch_cells // config.coarse_cells
        self._ground = KnownGround()
        self._pool = TilePool(
            (
                Layer((config.patch_cells, config.patch_cells), np.uint8),
                Layer((coarse, coarse), np.uint8),
                Layer((), np.uint8),  # 1: changed since it was loaded
            ),
            config.resident_patches,
        )
        self._tiles = TileMap(self._pool)
        self._slots: dict[PatchKey, int] = {}  # of the patches in memory, least recently used first

    @property
    def fine(self) -> LikelihoodLayer:
        return self._layer(0, self.config.cell_m)

    @property
    def coarse(self) -> LikelihoodLayer:
        return self._layer(1, self.config.coarse_cell_m)

    @property
    def resident(self) -> list[PatchKey]:
        """Patches in memory, least recently used first."""
        return list(self._slots)

    def prepare(self, xy_map: Array, margin_m: float) -> None:
        """Load the stored patches within margin_m of some points, (N, 2) m."""
        near = self._touched(xy_map, margin_m)
        for key in near:
            if key not in self._slots and self._store.holds(key):
                self._bring_in(key, near)
        self._use(near)

    def overlap(self, xy_base: Array, pose: SE2) -> Overlap:
        return self._ground.overlap(xy_base, pose)

    def join(self, segment: int) -> None:
        """Nothing to do: the map is a single segment."""

    def insert(self, points: Points, match: Match) -> MapChange:
        """Insert a matched scan, then prefetch one patch.

        The paper inserts one scan a second, every 0.28 m. At 25 scans a second the pose would stand still: a
        scan inserted a centimetre behind attracts the next one, because cells are never cleared.
        """
        if match.state == "lost" or len(points.xy_base) == 0:
            return MapChange()
        pose, config = match.motion.pose_odom_base, self.config
        xy_map = moved_by(pose, points.xy_base)
        near = self._touched(xy_map, 3 * config.coarse_cell_m)
        if self._last is not None and not pose.is_step_from(
            self._last, config.insert_distance_m, config.insert_turn_rad
        ):
            self._look_ahead(xy_map, near)
            return MapChange()
        self._last = pose
        join_m, lines_map = self._join_m(points), np.empty_like(xy_map)
        smooth_lines(xy_map, points.beam, join_m, self.config.smooth_m, lines_map)
        touched = self._touched(_along(lines_map, join_m, config.coarse_cell_m), 4 * config.coarse_cell_m)
        for key in touched:
            if key not in self._slots:
                self._bring_in(key, touched)
        self._use(touched)
        changed = self._changed()
        rasterise_scan(
            lines_map, points.beam, self.fine, changed, self.levels, self.config.ring_cells, join_m
        )
        rasterise_scan(lines_map, points.beam, self.coarse, changed, self.levels, 1, join_m)
        self._ground.insert(points, pose)
        self.is_empty = False
        self._look_ahead(xy_map, near)
        return MapChange(is_keyframe=True)

    def _join_m(self, points: Points) -> Array:
        """(N,) longest line to each point: on an oblique wall points are far apart."""
        sensor = points.sensor_base
        range_m = np.hypot(points.xy_base[:, 0] - sensor.x_m, points.xy_base[:, 1] - sensor.y_m)
        arc_m = abs(points.scan.angle_step_rad) * range_m
        join_m: Array = self.config.join_m + self.config.join_steps * arc_m
        return join_m

    def _look_ahead(self, xy_map: Array, near: list[PatchKey]) -> None:
        """Prefetch one patch per scan, so that no scan waits for many."""
        soon = [
            key
            for key in self._touched(xy_map, self.config.ahead_m)
            if key not in self._slots and self._store.holds(key)
        ]
        self._store.expect(soon)
        if soon:
            self._bring_in(soon[0], near)

    def _layer(self, number: int, cell_m: float) -> LikelihoodLayer:
        cells = self._pool.arrays[number]
        return LikelihoodLayer(self._tiles.index(), cells, 0.0, self._offset, self._scale, cell_m)  # type: ignore[arg-type]

    def _changed(self) -> npt.NDArray[np.uint8]:
        return self._pool.arrays[2]  # type: ignore[return-value]

    def _touched(self, xy_map: Array, margin_m: float) -> list[PatchKey]:
        """Patches within a margin, at most half a patch, of some points, by row and column."""
        if len(xy_map) == 0:
            return []
        patch_m = self.config.patch_m
        first_column, first_row = np.floor((xy_map.min(axis=0) - margin_m) / patch_m).astype(int).tolist()
        last_column, last_row = np.floor((xy_map.max(axis=0) + margin_m) / patch_m).astype(int).tolist()
        marks = np.zeros((last_row - first_row + 1, last_column - first_column + 1), np.uint8)
        mark_patches(xy_map, margin_m, patch_m, first_row, first_column, marks)
        return [(first_row + row, first_column + column) for row, column in np.argwhere(marks).tolist()]

    def _use(self, keys: Iterable[PatchKey]) -> None:
        for key in keys:
            if key in self._slots:
                self._slots[key] = self._slots.pop(key)

    def _bring_in(self, key: PatchKey, wanted: Iterable[PatchKey]) -> None:
        """Load a patch into memory; patches in `wanted` are not evicted."""
        if len(self._slots) >= self.config.resident_patches:
            oldest = next((other for other in self._slots if other not in wanted), None)
            if oldest is not None:
                self._put_away(oldest)
        row, column = key
        self._tiles.cover(TileRange(row, column, row, column))
        slot, used_before = self._tiles.take(row, column)
        fine, coarse, changed = self._pool.arrays
        changed[slot] = 0
        if not self._store.load(key, (fine[slot], coarse[slot])) and used_before:
            fine[slot] = 0
            coarse[slot] = 0
        self._slots[key] = slot

    def _put_away(self, key: PatchKey) -> None:
        slot = self._slots.pop(key)
        fine, coarse, changed = self._pool.arrays
        if changed[slot]:
            self._store.save(key, (fine[slot], coarse[slot]))
        self._tiles.drop(*key)


def _along(lines_map: Array, join_m: Array, apart_m: float) -> Array:
    """The points (N, 2), and points at most apart_m apart on each line of at most join_m (N,).

    A line between two points may cross the corner of a patch that contains neither.
    """
    steps = np.diff(lines_map, axis=0)
    lengths_m = np.hypot(*steps.T)
    counts = np.where(lengths_m <= join_m[1:], np.maximum(np.ceil(lengths_m / apart_m), 1.0), 1.0)
    counts = counts.astype(np.int64)
    first = np.repeat(np.cumsum(counts) - counts, counts)
    share = (np.arange(len(first)) - first) / np.repeat(counts, counts)
    along = np.repeat(lines_map[:-1], counts, axis=0) + share[:, None] * np.repeat(steps, counts, axis=0)
    places: Array = np.concatenate((along, lines_map[-1:]))
    return places
