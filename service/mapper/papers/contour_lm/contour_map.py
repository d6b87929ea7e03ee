"""A likelihood map learned from all scans, as a pyramid: blurred contours and a background model."""

from typing import Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field

from drivers.section import Section
from service.geometry.se2 import SE2
from service.kernels.background import LearningSettings, learn_scan, mark_passed
from service.kernels.contour_blur import (
    BlurSettings,
    LikelihoodLevel,
    ScanCells,
    blur_reach_cells,
    blur_scan,
    clear_scan,
)
from service.kernels.contours import extract_contours
from service.kernels.likelihood import LikelihoodField
from service.kernels.likelihood_search import LikelihoodLayer
from service.kernels.surfels import TILE_BITS, TILE_CELLS
from service.mapper.components import MapChange, Match, Overlap, Points
from service.mapper.maps.known_ground import KnownGround
from service.mapper.maps.tiles import Layer, TileMap, TilePool, reach_of
from service.mapper.matchers.window_search import layer_of

POOL_TILES = 65_536  # 0.9 GB of address space: 0.17 km2 at 5 cm
FIRST_SCAN_CELLS = 65_536


class ContoursConfig(Section):
    """Which neighbouring end points are joined (eq. 5), and the use of the others."""

    longest_step_m: float = Field(default=0.15, gt=0.0)  # d_th
    most_ratio: float = Field(default=2.0, ge=1.0)  # r_th
    lone_points: bool = False  # points without a contour enter the map as blobs


class BlurConfig(Section):
    """Likelihood beside a contour (eqs. 6 and 7). Lengths in cells, equal on every level."""

    along_cells: float = Field(default=10.0, gt=0.0)
    across_cells: float = Field(default=1.5, gt=0.0)
    traditional: bool = False  # the contour as likely as its points, blurred across only
    squared: bool = False  # a Gaussian instead of the printed exponent
    least: float = Field(default=0.05, gt=0.0, lt=1.0)  # smaller likelihoods count as 0


class LearningConfig(Section):
    """How the map changes with each scan (eqs. 13 to 18)."""

    rate: float = Field(default=0.01, gt=0.0, lt=1.0)  # w_l
    control: float = Field(default=3.0, ge=0.0)  # tau
    protect_count: int = Field(default=1000, ge=0, le=65_534)  # n_th
    sigma_cells: float = Field(default=1.5, gt=0.0, le=10.0)  # sigma_l
    decrease: bool = True
    update: Literal["averaged", "printed"] = "averaged"  # printed: max() at a hit, interpolation beside it
    bounded: bool = True  # printed interpolation stops at the scan's own likelihood; False: it fills up
    free_range_m: float = Field(default=20.0, gt=0.0)  # length up to which beams lower cells


class ContourMapConfig(Section):
    cell_m: float = Field(default=0.025, ge=0.005, le=0.5)  # of the finest level
    levels: int = Field(default=3, ge=1, le=6)  # each with cells twice as wide as the previous one
    insert_distance_m: float = Field(default=0.05, ge=0.0)  # learn after this path length,
    insert_turn_rad: float = Field(default=0.05, ge=0.0)  # ... or rotation,
    insert_time_s: float = Field(default=0.0, ge=0.0)  # ... or time; 0: every scan
    contours: ContoursConfig = ContoursConfig()
    blur: BlurConfig = BlurConfig()
    learning: LearningConfig = LearningConfig()


class ContourMap:
    """LocalMap. Levels from the finest to the coarsest, in the odom frame."""

    def __init__(self, config: ContourMapConfig) -> None:
        self._config = config
        blur, learning = config.blur, config.learning
        self._blur = BlurSettings(
            float("inf") if blur.traditional else blur.along_cells,
            blur.across_cells,
            blur.squared,
            blur.least,
            config.contours.lone_points,
        )
        self._learning = LearningSettings(
            learning.rate,
            learning.control,
            learning.protect_count,
            learning.sigma_cells,
            learning.update == "printed",
            learning.bounded,
        )
        self._cells = _room_for(FIRST_SCAN_CELLS)
        self.start_over()

    def start_over(self) -> None:
        cells = (TILE_CELLS, TILE_CELLS)
        self._pool = TilePool(
            (
                Layer(cells, np.float32),
                Layer(cells, np.float32),
                Layer(cells, np.uint16),
                Layer(cells, np.int32),
            ),
            POOL_TILES,
        )
        self._tiles = [TileMap(self._pool) for _ in range(self._config.levels)]
        self._last: tuple[int, SE2] | None = None  # stamp and pose of the last learned scan
        self._skipped = 0  # scans since then
        self._ground = KnownGround()

    @property
    def is_empty(self) -> bool:
        return self._last is None

    @property
    def level_count(self) -> int:
        return self._config.levels

    @property
    def tile_count(self) -> int:
        return self._pool.used_count

    def level(self, number: int) -> LikelihoodLevel:
        """The arrays of a level, 0 is the finest; valid until the next insert."""
        index = self._tiles[number].index()
        return LikelihoodLevel(index, *self._pool.arrays, self._cell_m(number))  # type: ignore[arg-type, call-arg]

    def field(self, number: int) -> LikelihoodField:
        """A level with interpolation between cells; valid until the next insert."""
        level = self.level(number)
        return LikelihoodField(level.tiles, level.likelihood, level.cell_m)

    def search_layer(self) -> LikelihoodLayer:
        """The coarsest level, for a search."""
        return layer_of(self.field(self.level_count - 1))

    def overlap(self, xy_base: npt.NDArray[np.float64], pose: SE2) -> Overlap:
        return self._ground.overlap(xy_base, pose)

    def join(self, segment: int) -> None:
        """Nothing to do: the map is a single segment."""

    def insert(self, points: Points, match: Match) -> MapChange:
        if not len(points.xy_base) or match.state == "lost":
            return MapChange()
        pose = match.motion.pose_odom_base
        if not self._is_due(points.scan.stamp_ns, pose):
            self._skipped += 1
            return MapChange()
        learning = self._learning._replace(scans=1 + self._skipped)
        pose_vector = np.array(pose)
        contour = np.empty(len(points.xy_base), np.int32)
        contours = self._config.contours
        extract_contours(points.xy_base, contours.longest_step_m, contours.most_ratio, contour)
        reach_m = reach_of(points.xy_base)
        margin_cells = 2 + int(2.0 * blur_reach_cells(self._blur))
        for number, tiles in enumerate(self._tiles):
            tiles.cover_around((pose.x_m, pose.y_m), reach_m, self._cell_m(number), TILE_BITS, margin_cells)
            level = self.level(number)
            self._mark(points, contour, pose_vector, level)
            while self._cells.rows[0] > len(self._cells.value):
                wanted = 2 * int(self._cells.rows[0])
                clear_scan(level, self._cells)
                self._cells = _room_for(wanted)
                self._mark(points, contour, pose_vector, level)
            learn_scan(level, learning, self._cells)
            clear_scan(level, self._cells)
        self._ground.insert(points, pose)
        self._last = (points.scan.stamp_ns, pose)
        self._skipped = 0
        return MapChange(is_keyframe=True)

    def _is_due(self, stamp_ns: int, pose: SE2) -> bool:
        """Whether the next scan is learned; it then stands for those skipped before it."""
        if self._last is None:
            return True
        config = self._config
        last_ns, last = self._last
        return (stamp_ns - last_ns) * 1e-9 >= config.insert_time_s or pose.is_step_from(
            last, config.insert_distance_m, config.insert_turn_rad
        )

    def _mark(
        self,
        points: Points,
        contour: npt.NDArray[np.int32],
        pose: npt.NDArray[np.float64],
        level: LikelihoodLevel,
    ) -> None:
        """List the cells of a level that the scan observes; the list may be too short."""
        learning = self._config.learning
        blur_scan(points.xy_base, contour, pose, level, self._blur, self._cells)
        if learning.decrease:
            mark_passed(
                points.xy_base,
                points.sensor_xy_m,
                pose,
                level,
                learning.protect_count,
                learning.free_range_m,
                self._cells,
            )

    def _cell_m(self, number: int) -> float:
        return self._config.cell_m * float(2**number)


def _room_for(cell_count: int) -> ScanCells:
    return ScanCells(
        np.empty((cell_count, 3), np.int32),
        np.empty(cell_count, np.uint8),
        np.empty(cell_count, np.float32),
        np.empty(cell_count, np.float32),
        np.zeros(1, np.int64),
    )
