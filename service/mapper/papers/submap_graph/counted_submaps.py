"""Sub-maps of counts, one for each particle of a particle filter."""

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from pydantic import Field

from drivers.section import Section
from service.geometry.se2 import SE2, wrap_angle
from service.kernels.counted_occupancy import CountedGrid, CountWeights, count_overlap, count_scan
from service.kernels.likelihood import LikelihoodField
from service.kernels.surfels import TILE_BITS, TILE_CELLS
from service.mapper.components import MapChange, Match, Overlap, Points
from service.mapper.maps.tiles import Layer, TileMap, TilePool, reach_of
from service.mapper.papers.submap_graph.key_scan import InsertedScan, KeyScan

SAME_WALL_M = 0.10  # largest distance of a return from its wall
POOL_TILES = 131_072  # 1.3 GB of address space; only touched pages take memory


class CountedSubmapsConfig(Section):
    """How sub-maps are cut, and the weight of a count."""

    particles: int = Field(default=30, ge=1, le=1000)
    cell_m: float = Field(default=0.05, ge=0.02, le=0.5)
    occupied_by_hit: float = Field(default=0.7, gt=0.5, lt=1.0)  # O_o
    occupied_by_pass: float = Field(default=0.4, gt=0.0, lt=0.5)  # O_f
    free_range_m: float = Field(default=6.0, gt=0.0)
    pass_stride: int = Field(default=2, ge=1)  # every so many beams clear cells; all of them hit
    length_m: float = Field(default=12.0, gt=0.0)  # path length of a sub-map
    overlap_m: float = Field(default=4.0, ge=0.0)  # of its end that is also inserted into the next one
    keyframe_distance_m: float = Field(default=0.30, gt=0.0)
    keyframe_turn_rad: float = Field(default=0.10, gt=0.0)
    first_scans: int = Field(default=3, ge=1)  # of an empty map, also at standstill

    @property
    def weights(self) -> CountWeights:
        return CountWeights(
            math.log(self.occupied_by_hit / (1.0 - self.occupied_by_hit)),
            math.log(self.occupied_by_pass / (1.0 - self.occupied_by_pass)),
        )


@dataclass(frozen=True, slots=True, eq=False)
class ClosedSubmap:
    """A finished sub-map: the path of the best particle, and its scans. Can be pickled.

    number   rises by one from sub-map to sub-map
    scans    K scans; the first `carried` of them belong to the previous sub-map as well
    track    (K, 3) float64   pose of the best particle at each, in the odom frame
    config   of its map
    """

    number: int
    carried: int
    scans: tuple[InsertedScan, ...]
    track: npt.NDArray[np.float64]
    config: CountedSubmapsConfig


@dataclass(frozen=True, slots=True)
class CountedChange(MapChange):
    """MapChange with the sub-map that the insert closed."""

    closed: ClosedSubmap | None = None


class CountedMap:
    """Tiles of counts in a shared pool."""

    def __init__(self, pool: TilePool, config: CountedSubmapsConfig) -> None:
        self._tiles = TileMap(pool)
        self._cell_m = config.cell_m
        self._weights = config.weights
        self._free_range_m = config.free_range_m
        self._pass_stride = config.pass_stride
        self._scan_number = 0

    @staticmethod
    def new_pool(capacity: int = POOL_TILES) -> TilePool:
        shape = (TILE_CELLS, TILE_CELLS)
        return TilePool(
            (
                Layer(shape, np.uint16),
                Layer(shape, np.uint16),
                Layer(shape, np.float32),
                Layer(shape, np.uint16),
            ),
            capacity,
        )

    def grid(self) -> CountedGrid:
        hits, passes, field, touched = self._tiles.pool.arrays
        return CountedGrid(self._tiles.index(), hits, passes, field, touched, self._cell_m)  # type: ignore[arg-type]

    def likelihood(self) -> LikelihoodField:
        field = self._tiles.pool.arrays[2]
        return LikelihoodField(self._tiles.index(), field, self._cell_m)  # type: ignore[arg-type]

    def insert(
        self,
        xy_base: npt.NDArray[np.float64],
        sensor_xy_m: npt.NDArray[np.float64],
        pose: npt.NDArray[np.float64],
    ) -> None:
        """Count a scan; after 65 535 of them a cell may count one twice."""
        reach_m = max(reach_of(xy_base), reach_of(sensor_xy_m.reshape(1, 2)))
        x_m, y_m, _ = pose.tolist()
        self._tiles.cover_around((x_m, y_m), reach_m, self._cell_m, TILE_BITS)
        self._scan_number = self._scan_number % 65_535 + 1
        count_scan(
            xy_base,
            sensor_xy_m,
            pose,
            self.grid(),
            self._weights,
            self._free_range_m,
            self._pass_stride,
            np.uint16(self._scan_number),
        )

    def copy_from(self, other: "CountedMap") -> None:
        """Become a copy of a map of the same pool."""
        self._tiles.copy_from(other._tiles)
        self._scan_number = other._scan_number

    def tiles(self) -> list[tuple[int, int, int]]:
        """(tile row, tile column, slot) of every tile, by row and column."""
        return self._tiles.tiles()

    def release(self) -> None:
        self._tiles.release()


@dataclass(slots=True, eq=False)
class Particle:
    """One hypothesis of the sub-map: pose of the base, its poses at the key scans, and its map."""

    map: CountedMap
    pose: npt.NDArray[np.float64]  # (3,) m, m, rad in the odom frame
    track: list[npt.NDArray[np.float64]] = field(default_factory=list)


class CountedSubmaps:
    """The sub-map in progress, once per particle; the matcher moves the particles.

    Every length_m the best particle's is closed, and all particles continue from it. The last overlap_m of
    its path is inserted into the next one first, so that the next scan meets a map instead of a single scan.
    """

    def __init__(self, config: CountedSubmapsConfig) -> None:
        self.config = config
        self._pool = CountedMap.new_pool()
        self._scans: list[KeyScan] = []
        self._carried = 0
        self._number = 0
        self._travelled_m = 0.0
        self._broken_off: ClosedSubmap | None = None  # closed early, to be returned
        self.particles = [Particle(self._new_map(), np.zeros(3)) for _ in range(config.particles)]
        self.log_weights = np.zeros(config.particles)
        self.weights = np.full(config.particles, 1.0 / config.particles)

    @property
    def is_empty(self) -> bool:
        """Whether no scan was inserted yet."""
        return not self._scans

    @property
    def tile_count(self) -> int:
        return self._pool.used_count

    @property
    def best(self) -> Particle:
        return self.particles[int(np.argmax(self.weights))]

    def overlap(self, xy_base: npt.NDArray[np.float64], pose: SE2) -> Overlap:
        return self._overlap(self.best.map, xy_base, np.array(pose))

    def overlap_of(self, particle: Particle, xy_base: npt.NDArray[np.float64]) -> Overlap:
        """Overlap of a scan with the map of a particle, at its pose."""
        return self._overlap(particle.map, xy_base, particle.pose)

    def gather(self, pose: SE2) -> None:
        """Set every particle to a pose in odom."""
        for particle in self.particles:
            particle.pose = np.array(pose)

    def start_over(self) -> None:
        """Close the sub-map as it is; the next one starts empty."""
        self._broken_off = self._close(self.best, overlap_m=-1.0)

    def take_over(self, chosen: npt.NDArray[np.int64]) -> None:
        """Replace particle n by particle chosen[n], all with equal weights; chosen rises."""
        survivors = set(chosen.tolist())
        given = set()
        copies = []
        for k in chosen.tolist():
            if k not in given:
                given.add(k)
            else:
                copies.append(k)
        dead = [n for n in range(len(self.particles)) if n not in survivors]
        for n, k in zip(dead, copies, strict=True):
            self._become(self.particles[n], self.particles[k])
        self.log_weights[:] = 0.0
        self.weights[:] = 1.0 / len(self.particles)

    def join(self, segment: int) -> None:
        """Nothing to do: the map is a single segment."""

    def insert(self, points: Points, match: Match) -> CountedChange:
        """Insert a key scan into every particle's map, at the particle's own pose."""
        if not len(points.xy_base) or match.state == "lost":
            return CountedChange()
        if self.is_empty:
            self.gather(match.motion.pose_odom_base)
        best = self.best
        if len(self._scans) >= self.config.first_scans and not self._is_keyframe(best):
            return CountedChange()
        if best.track:
            self._travelled_m += math.hypot(*(best.pose - best.track[-1])[:2])
        sensor = (points.sensor_base.x_m, points.sensor_base.y_m)
        self._scans.append(
            KeyScan(
                points.scan.stamp_ns,
                points.xy_base.astype(np.float32),
                sensor,
                abs(points.scan.angle_step_rad),
            )
        )
        for particle in self.particles:
            particle.map.insert(points.xy_base, np.array(sensor), particle.pose)
            particle.track.append(particle.pose.copy())
        if self._broken_off is not None:
            closed, self._broken_off = self._broken_off, None
            return CountedChange(is_keyframe=True, closed=closed)
        if self._travelled_m < self.config.length_m:
            return CountedChange(is_keyframe=True)
        closed = self._close(best, self.config.overlap_m)
        return CountedChange(is_keyframe=True, closed=closed)

    def _is_keyframe(self, best: Particle) -> bool:
        last = SE2(*best.track[-1].tolist())
        return self.pose_of(best).is_step_from(
            last, self.config.keyframe_distance_m, self.config.keyframe_turn_rad
        )

    def _close(self, best: Particle, overlap_m: float) -> ClosedSubmap:
        """Begin the next sub-map with the end of the best particle's; overlap_m below 0: empty."""
        closed = ClosedSubmap(
            self._number, self._carried, tuple(self._scans), np.array(best.track), self.config
        )
        self._number += 1
        steps_m = np.hypot(*np.diff(closed.track[:, :2], axis=0).T)
        back_m = np.append(np.cumsum(steps_m[::-1])[::-1], 0.0)  # from each scan to the end
        first = len(back_m) if overlap_m < 0.0 else max(int(np.argmax(back_m <= overlap_m)), 1)
        self._scans = self._scans[first:]
        self._carried = len(self._scans)
        self._travelled_m = 0.0
        pose, track = best.pose.copy(), best.track[first:]
        for particle in self.particles:
            particle.map.release()
        leader = self.particles[0]
        for scan, at in zip(self._scans, track, strict=True):
            leader.map.insert(scan.xy_base.astype(np.float64), np.array(scan.sensor_xy_m), at)
        leader.pose, leader.track = pose, list(track)
        for particle in self.particles[1:]:
            self._become(particle, leader)
        self.log_weights[:] = 0.0
        self.weights[:] = 1.0 / len(self.particles)
        return closed

    def _overlap(
        self, map_: CountedMap, xy_base: npt.NDArray[np.float64], pose: npt.NDArray[np.float64]
    ) -> Overlap:
        reach_cells = math.ceil(SAME_WALL_M / self.config.cell_m)
        return Overlap(*count_overlap(xy_base, pose, map_.grid(), reach_cells))

    def pose_of(self, particle: Particle) -> SE2:
        x_m, y_m, theta_rad = particle.pose.tolist()
        return SE2(x_m, y_m, wrap_angle(theta_rad))

    def _become(self, particle: Particle, other: Particle) -> None:
        particle.map.copy_from(other.map)
        particle.pose = other.pose.copy()
        particle.track = list(other.track)

    def _new_map(self) -> CountedMap:
        return CountedMap(self._pool, self.config)
