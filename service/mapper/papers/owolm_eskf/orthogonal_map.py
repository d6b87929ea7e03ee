"""OWOLM: a pyramid of likelihood maps along the axes of the building, in which straight walls weigh more."""

import logging
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field

from drivers.section import Section
from service.geometry.grid import tiles_of
from service.geometry.poses import moved_by
from service.geometry.se2 import SE2, wrap_angle
from service.kernels.blurred_segments import NO_SEGMENT, segments_along
from service.kernels.likelihood import LikelihoodField
from service.kernels.likelihood_search import LikelihoodLayer
from service.kernels.orthogonal_weights import FULL, MAXIMUM, NOISY_OR, WeightedLayer, insert_weighted
from service.kernels.surfels import TILE_BITS, TILE_CELLS
from service.mapper.components import MapChange, Match, Overlap, Points
from service.mapper.maps.known_ground import KnownGround
from service.mapper.maps.tiles import Layer, TileMap, TilePool
from service.mapper.matchers.field_align import values_at
from service.mapper.papers.owolm_eskf.building_axes import building_axes

log = logging.getLogger(__name__)

POOL_TILES = 262_144  # 1.3 GB of address space a level; only touched pages take memory
RULES = {"noisy_or": NOISY_OR, "maximum": MAXIMUM}


class SegmentsConfig(Section):
    """Which points form an orthogonal blurred segment."""

    width_m: float = Field(default=0.04, gt=0.0)  # twice the ranging error
    least_points: int = Field(default=20, ge=2)
    length_m: float = Field(default=1.0, gt=0.0)
    gap_m: float = Field(default=0.03, ge=0.0)  # gap_m + gap_steps * angle step * range splits a segment
    gap_steps: float = Field(default=3.0, ge=0.0)


class OrthogonalMapConfig(Section):
    """The pyramid, and how a point is blurred."""

    cell_m: float = Field(default=0.025, ge=0.005, le=0.5)  # of the finest level
    ratio: Literal[2, 4, 5] = 4
    levels: int = Field(default=3, ge=1, le=6)
    align_share: float = Field(default=0.35, gt=0.0, le=1.0)
    weigh_segments: bool = True  # off: the plain occupancy likelihood map
    segments: SegmentsConfig = SegmentsConfig()
    segment_sigma_cells: float = Field(default=0.5, gt=0.0)
    other_sigma_cells: float = Field(default=3.0, gt=0.0)
    about_point: bool = True
    rule: Literal["noisy_or", "maximum"] = "noisy_or"
    insert_distance_m: float = Field(default=0.3, ge=0.0)
    insert_turn_rad: float = Field(default=0.1, ge=0.0)
    # A scan with a lower inlier ratio is inserted at once.
    insert_inlier_ratio: float = Field(default=0.9, ge=0.0, le=1.0)
    on_map_likelihood: float = Field(default=0.02, gt=0.0, le=1.0)  # least likelihood of an inlier
    first_scans: int = Field(default=1, ge=1)


@dataclass(slots=True)
class _Level:
    cell_m: float
    pool: TilePool
    tiles: TileMap

    def layer(self) -> WeightedLayer:
        likelihood, cells = self.pool.arrays
        return WeightedLayer(self.tiles.index(), likelihood, cells, self.cell_m)  # type: ignore[arg-type]


class OrthogonalMap:
    """LocalMap. Level 0 is the finest; each inserted scan goes into every level."""

    def __init__(self, config: OrthogonalMapConfig) -> None:
        self._config = config
        narrow, wide = config.segment_sigma_cells, config.other_sigma_cells
        self._sigma_cells = np.array([[wide, wide], *3 * [[narrow, narrow]]])
        self.pose_axes_odom = SE2()  # odom in the axes of the building; set by the first scan
        self.start_over()

    def start_over(self) -> None:
        config = self._config
        self._levels = []
        for level in range(config.levels):
            layers = Layer((TILE_CELLS, TILE_CELLS), np.float32), Layer((TILE_CELLS, TILE_CELLS), np.uint8)
            pool = TilePool(layers, POOL_TILES >> min(2 * level, 8))
            self._levels.append(_Level(config.cell_m * config.ratio**level, pool, TileMap(pool)))
        self._scan_count = 0
        self._last: SE2 | None = None
        self._ground = KnownGround()

    @property
    def is_empty(self) -> bool:
        return self._scan_count == 0

    @property
    def ratio(self) -> int:
        return self._config.ratio

    def search_layers(self) -> list[LikelihoodLayer]:
        """The layers for an exhaustive search, the finest first; valid until the next insert()."""
        layers = []
        for level in self._levels:
            cells = level.pool.arrays[1]
            layers.append(
                LikelihoodLayer(level.tiles.index(), cells, 0.0, 0.0, 1.0 / FULL, level.cell_m)  # type: ignore[arg-type]
            )
        return layers

    def field(self) -> LikelihoodField:
        """The finest level, with interpolation between cells; valid until the next insert()."""
        finest = self._levels[0]
        return LikelihoodField(finest.tiles.index(), finest.pool.arrays[0], finest.cell_m)  # type: ignore[arg-type]

    def overlap(self, xy_base: npt.NDArray[np.float64], pose: SE2) -> Overlap:
        return self._ground.overlap(xy_base, pose)

    def occupied(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Centres of the finest cells that are not empty, (N, 2) m in the odom frame; likelihoods."""
        finest = self._levels[0]
        centres: list[npt.NDArray[np.float64]] = [np.empty((0, 2))]
        values = [np.empty(0)]
        for tile_row, tile_column, slot in finest.tiles.tiles():
            likelihood = finest.pool.arrays[0][slot]
            row, column = np.nonzero(likelihood)
            place = np.column_stack([column + tile_column * TILE_CELLS, row + tile_row * TILE_CELLS])
            centres.append(np.asarray((place + 0.5) * finest.cell_m))
            values.append(likelihood[row, column].astype(np.float64))
        return moved_by(self.pose_axes_odom.inverse(), np.concatenate(centres)), np.concatenate(values)

    def join(self, segment: int) -> None:
        """Nothing to do: the map is a single segment."""

    def insert(self, points: Points, match: Match) -> MapChange:
        pose = match.motion.pose_odom_base
        if match.state == "lost" or len(points.xy_base) == 0 or not self._is_due(points, match):
            return MapChange()
        gap_m = self.gaps(points)
        if self.is_empty:
            self._align(points, gap_m, pose)
        self._last = pose
        self._scan_count += 1
        self._ground.insert(points, pose)
        xy_map = moved_by(self.pose_axes_odom @ pose, points.xy_base)
        segment = self.segments(xy_map, gap_m)
        for level in self._levels:
            level.tiles.cover(
                tiles_of(
                    (float(xy_map[:, 0].min()), float(xy_map[:, 1].min())),
                    (float(xy_map[:, 0].max()), float(xy_map[:, 1].max())),
                    level.cell_m,
                    TILE_BITS,
                    margin_cells=1,
                )
            )
            insert_weighted(
                xy_map,
                segment,
                self._sigma_cells,
                self._config.about_point,
                RULES[self._config.rule],
                level.layer(),
            )
        return MapChange(is_keyframe=True)

    def segments(
        self, xy_map: npt.NDArray[np.float64], gap_m: npt.NDArray[np.float64]
    ) -> npt.NDArray[np.int32]:
        """(N, 2) segments parallel to x and to y that each point is in; NO_SEGMENT for none."""
        config = self._config.segments
        segment = np.full((len(xy_map), 2), NO_SEGMENT, np.int32)
        if self._config.weigh_segments:
            limits = np.array([config.width_m, config.length_m])
            for axis in range(2):
                segments_along(xy_map, axis, gap_m, limits, config.least_points, segment)
        return segment

    def gaps(self, points: Points) -> npt.NDArray[np.float64]:
        """(N,) m: largest distance to the next point of the same surface."""
        config = self._config.segments
        away = points.xy_base - (points.sensor_base.x_m, points.sensor_base.y_m)
        gaps: npt.NDArray[np.float64] = config.gap_m + config.gap_steps * abs(
            points.scan.angle_step_rad
        ) * np.hypot(away[:, 0], away[:, 1])
        return gaps

    def _align(self, points: Points, gap_m: npt.NDArray[np.float64], pose: SE2) -> None:
        axes_rad = building_axes(points.xy_base, gap_m, self._config.align_share)
        if axes_rad is None:
            log.warning(
                "%s: no direction of walls stands out in the first scan; the map keeps its axes. "
                "Straight walls weigh more only where they run along these",
                points.scan.sensor,
            )
            return
        self.pose_axes_odom = SE2(0.0, 0.0, -wrap_angle(pose.theta_rad + axes_rad))

    def _inlier_ratio(self, points: Points, pose: SE2) -> float:
        at = self.pose_axes_odom @ pose
        values = values_at(points.xy_base, np.array(at), self.field())
        return float((values[:, 0] >= self._config.on_map_likelihood).mean())

    def _is_due(self, points: Points, match: Match) -> bool:
        if self._last is None or self._scan_count < self._config.first_scans:
            return True
        matched = match.motion if match.measured is None else match.measured
        if self._inlier_ratio(points, matched.pose_odom_base) < self._config.insert_inlier_ratio:
            return True
        return match.motion.pose_odom_base.is_step_from(
            self._last, self._config.insert_distance_m, self._config.insert_turn_rad
        )
