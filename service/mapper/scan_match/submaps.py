"""The local map of the default profile: two overlapping sub-maps of surfels; scans match the older one."""

import math

import numpy as np
import numpy.typing as npt
from pydantic import Field

from drivers.section import Section
from service.geometry.poses import Floats
from service.geometry.se2 import SE2, wrap_angle
from service.kernels.likelihood import SPLAT_REACH_CELLS, splat_likelihood
from service.kernels.small_objects import pull_of_small_objects
from service.kernels.static_score import (
    ENTERED_FREE,
    Observations,
    StaticScoreSettings,
    count_hits,
    remove_by_ray_cast,
    weigh_static_score,
)
from service.kernels.static_walls import (
    count_beams_through_walls,
    count_contradicting,
    find_dynamic,
    static_residuals,
)
from service.kernels.surfels import (
    COLUMNS,
    LASERS,
    MIN_NORMAL_COSINE,
    PARTS,
    TILE_BITS,
    TILE_CELLS,
    SurfelGrid,
    insert_surfels,
    shorten_surfels,
)
from service.kernels.tiles import NO_TILE
from service.mapper.components import MapChange, Match, Points, Standing
from service.mapper.judgement import too_few
from service.mapper.maps.tiles import Layer, TileMap, TilePool, reach_of
from service.mapper.scan_match.narrow_walls import NarrowWalls, narrow_wall_pool
from service.mapper.scan_match.posts import Posts, posts_of, walls_seen

FIRST_SCANS = 25  # of a map, inserted even at standstill: half a second of a 50 Hz laser
SURFEL_COUNT_LIMIT = 1000.0  # points of one laser that a surfel averages over, so that it follows changes
SURFEL_SIGMA_M = 0.01  # unit in which surfels count points; no pose depends on it
FIELD_SIGMA_M = 0.15  # of a point in the coarse field: wide enough to attract a start that is off by a cell
SATURATED_LIKELIHOOD = 0.95  # likelihood of a cell above which more points are skipped
SUBMAP_POOL_TILES = 16_384  # 1.3 GB of address space; a sub-map in a large hall touches a few hundred tiles
FINE_POOL_TILES = 32_768  # 2.1 GB of address space: walls touch twice as many
NEW_SEGMENT_ERROR = 0.01  # factor on the pose's error against the map, of a segment that begins at the pose
MAX_MISSES = 3  # then another segment is begun
# What is seen over so much of the path is static: no object moves along for longer. In a cell that was free
# before it may be one of several objects that follow each other.
STATIC_PATH_M, ARRIVED_PATH_M = 1.0, 3.0
MARK_M = 0.05  # of the path, from one mark to the next
MAX_MARK = int(ENTERED_FREE) - 1  # the flag lies above all marks
TICK_S = 0.05  # unit of the static score
FREE_S = 0.25  # an object in a free cell must stay this long: a person of 0.3 m has left it by then
MIN_NEW_WEIGHT = 0.1  # of a new object over a static one: enough where nothing else is in view
MAX_GAIN = 2.0  # limit of the rescaling of weights: few points do not become many
BEAM_STEP = 3  # every third beam is traced, another third at each key frame


class DynamicFilterConfig(Section):
    """When an object counts fully, and when it is removed."""

    enough_s: float = Field(default=1.0, ge=0.0, le=6.0)  # 0: no dynamic filter
    behind_m: float = Field(default=0.2, gt=0.0)

    def settings(self) -> StaticScoreSettings:
        return StaticScoreSettings(
            ticks_in(self.enough_s), ticks_in(FREE_S), MIN_NEW_WEIGHT, MAX_GAIN, self.behind_m, BEAM_STEP
        )


class SubmapsConfig(Section):
    """How sub-maps are cut and filled."""

    dynamic_filter: DynamicFilterConfig = DynamicFilterConfig()
    cell_m: float = Field(default=0.10, ge=0.02, le=0.5)
    spacing_m: float = Field(default=20.0, gt=0.0)  # travel from one sub-map to the next
    keyframe_distance_m: float = Field(default=0.05, gt=0.0)
    keyframe_turn_rad: float = Field(default=0.05, gt=0.0)
    memory_m: float = Field(default=0.5, gt=0.0)


class Submap:
    """One sub-map of surfels, in the odom frame."""

    def __init__(
        self, number: int, pool: TilePool, fine: TilePool, narrow: TilePool, config: SubmapsConfig
    ) -> None:
        self.number = number
        self.narrow_walls = NarrowWalls(narrow, config.cell_m)
        self.scan_count = 0
        self.keyframe_distance_m = config.keyframe_distance_m  # scans within it match the same noise
        self._last_ns: int | None = None  # of its newest key frame
        self._last_pose: SE2 | None = None
        self._path_m = 0.0  # over its key frames
        self._config = config
        self._dynamic_filter = config.dynamic_filter.settings()
        self._tiles = TileMap(pool)
        self._fine_tiles = TileMap(fine)

    def grid(self) -> SurfelGrid:
        surfels, field, *_ = self._tiles.pool.arrays
        return SurfelGrid(self._tiles.index(), surfels, field, self._config.cell_m)  # type: ignore[arg-type]

    def fine_grid(self) -> SurfelGrid:
        """Surfels of the same points in finer cells, PARTS x PARTS for each, without a field."""
        surfels, field = self._fine_tiles.pool.arrays
        cell_m = self._config.cell_m / PARTS
        return SurfelGrid(self._fine_tiles.index(), surfels, field, cell_m)  # type: ignore[arg-type]

    def weigh(self, points: Points, pose: Floats, grid: SurfelGrid, normals: Floats) -> None:
        """Weigh the normals (N, 3) of a scan at a pose (3,) by the static score, in place. grid: grid()."""
        if self._dynamic_filter.full_score > 0:
            observations, settings = self._observations(), self._dynamic_filter
            weigh_static_score(points.xy_base, pose, grid, observations, settings, normals)

    def contradicting(
        self, points: Points, xy_base: Floats, normals: Floats, pose: Floats
    ) -> tuple[int, int]:
        """Points (N, 2) of a scan at a pose (3,) in free space, and behind walls on unknown ground."""
        behind_m = self._dynamic_filter.behind_m
        in_free, behind = count_contradicting(
            xy_base, points.sensor_xy_m, normals, pose, self.grid(), self._observations(), behind_m
        )
        return int(in_free), int(behind)

    def static_residuals(
        self, xy_base: Floats, normals: Floats, pose: Floats, path_m: float = STATIC_PATH_M
    ) -> Floats:
        """As residuals, to static walls: those seen over so much of the path, or ARRIVED_PATH_M."""
        arrived = _mark_at(self._path_m - max(ARRIVED_PATH_M, path_m))
        return self._residuals(xy_base, normals, pose, _mark_at(self._path_m - path_m), arrived)

    def residuals(self, xy_base: Floats, normals: Floats, pose: Floats) -> Floats:
        """(N,) m, residuals of points (N, 2) at a pose (3,) to walls; NaN without one."""
        return self._residuals(xy_base, normals, pose, MAX_MARK, MAX_MARK)

    def _residuals(self, xy_base: Floats, normals: Floats, pose: Floats, *latest: int) -> Floats:
        """latest: marks of the path as in the kernel."""
        residual_m = np.empty(len(xy_base))
        grid, observations = self.grid(), self._observations()
        static_residuals(xy_base, normals, pose, grid, observations, MIN_NORMAL_COSINE, *latest, residual_m)
        return residual_m

    def pull_of_small_objects(
        self, xy_base: Floats, normals: Floats, pose: Floats, variance_m2: float, prior_information: Floats
    ) -> tuple[Floats, npt.NDArray[np.bool_]]:
        """(3,) m, m, rad: how far small objects pull a match; and (N,) which returns are theirs."""
        is_small, pull = np.empty(len(xy_base), np.bool_), np.empty(3)
        grid, information = self.grid(), prior_information
        pull_of_small_objects(
            xy_base, normals, pose, grid, MIN_NORMAL_COSINE, variance_m2, information, is_small, pull
        )
        return pull, is_small

    def on_dynamic(self, xy_base: Floats, normals: Floats, pose: Floats) -> npt.NDArray[np.bool_]:
        """(N,) whether points are in cells not occupied over STATIC_PATH_M of the path."""
        is_dynamic = np.zeros(len(xy_base), np.bool_)
        find_dynamic(xy_base, normals, pose, self.grid(), self._observations(), self._static_mark, is_dynamic)
        return is_dynamic

    def beams_through_static(self, points: Points, xy_base: Floats, pose: Floats) -> int:
        """Number of beams that pass through static walls."""
        grid, observations, behind_m = self.grid(), self._observations(), self._dynamic_filter.behind_m
        return int(
            count_beams_through_walls(
                xy_base, points.sensor_xy_m, pose, grid, observations, self._static_mark, behind_m
            )
        )

    @property
    def knows_static(self) -> bool:
        """Whether its path is long enough for static walls."""
        return self._path_m >= STATIC_PATH_M

    @property
    def _static_mark(self) -> int:
        return _mark_at(self._path_m - STATIC_PATH_M)

    def insert(self, points: Points, normals: Floats, posts: Posts | None, pose: SE2, laser: int) -> None:
        """laser: as in insert_surfels."""
        cell_m = self._config.cell_m
        near, reach_m = (pose.x_m, pose.y_m), reach_of(points.xy_base)
        self._tiles.cover_around(near, reach_m, cell_m, TILE_BITS, SPLAT_REACH_CELLS)
        self._fine_tiles.cover_around(near, reach_m, cell_m / PARTS, TILE_BITS)
        grid = self.grid()
        pose_vector = np.array(pose)
        if self._last_pose is not None:
            self._path_m += math.hypot(pose.x_m - self._last_pose.x_m, pose.y_m - self._last_pose.y_m)
        self._last_pose = pose
        if self._dynamic_filter.full_score > 0:
            normals = self._update_static_score(points, normals, pose_vector, grid)
        if posts is None:  # round objects have another normal from each side
            normals = self.narrow_walls.insert(points, normals, pose_vector)
        walls = [(points.xy_base, normals)]
        if posts is not None:
            post_normals = posts.normals(pose.theta_rad, np.ones(len(posts.point)))
            walls.append((np.repeat(posts.xy_base, 2, axis=0), post_normals))
        point_count = (SURFEL_SIGMA_M / points.range_sigma_m) ** 2
        for surfels in (grid, self.fine_grid()):
            for xy, directions in walls:
                insert_surfels(
                    xy,
                    directions,
                    pose_vector,
                    surfels,
                    SURFEL_COUNT_LIMIT,
                    point_count,
                    points.sensor_xy_m,
                    laser,
                )
        splat_likelihood(points.xy_base, pose_vector, grid, FIELD_SIGMA_M, SATURATED_LIKELIHOOD)
        self.scan_count += 1

    def shorten(self, laser: int, step_m: float) -> None:
        """Move the walls by a change of a laser's constant range bias."""
        shorten_surfels(self.grid(), laser, step_m)
        shorten_surfels(self.fine_grid(), laser, step_m)

    def _update_static_score(self, points: Points, normals: Floats, pose: Floats, grid: SurfelGrid) -> Floats:
        """Update the static score by a key frame; returns its normals, with dynamic points at weight 0."""
        number = np.uint16(self.scan_count % np.iinfo(np.uint16).max + 1)  # 0: none
        ticks = np.int64(self._ticks_since(points.scan.stamp_ns))
        static = normals.copy()
        settings, observations = self._dynamic_filter, self._observations()
        mark = np.uint16(_mark_at(self._path_m))
        count_hits(points.xy_base, static, pose, grid, observations, settings, number, ticks, mark)
        remove_by_ray_cast(
            points.xy_base,
            points.sensor_xy_m,
            pose,
            grid,
            self.fine_grid(),
            observations,
            settings,
            number,
            ticks,
        )
        return static

    def _ticks_since(self, stamp_ns: int) -> int:
        """From the previous key frame to this stamp; at least 1."""
        last_ns = stamp_ns if self._last_ns is None else self._last_ns
        self._last_ns = stamp_ns
        return min(max(1, ticks_in((stamp_ns - last_ns) * 1e-9)), self._dynamic_filter.full_score)

    def standing(self) -> Standing | None:
        """As CountsStanding.standing, of this sub-map."""
        full_score, cell_m = self._dynamic_filter.full_score, self._config.cell_m
        if full_score == 0:
            return None
        rows, columns = np.nonzero(self._tiles.slots != NO_TILE)
        score = self._observations().score[self._tiles.slots[rows, columns]]
        tile, row, column = np.nonzero(score > 0)
        first_row, first_column = self._tiles.origin
        x_m = ((columns[tile] + first_column) * TILE_CELLS + column + 0.5) * cell_m
        y_m = ((rows[tile] + first_row) * TILE_CELLS + row + 0.5) * cell_m
        return Standing(np.column_stack((x_m, y_m)), score[tile, row, column] / full_score, cell_m)

    def _observations(self) -> Observations:
        _surfels, _field, score, touched, since = self._tiles.pool.arrays
        return Observations(score, touched, since)  # type: ignore[arg-type]

    def release(self) -> None:
        """Release the tiles and clear their observations; a tile taken again clears only its surfels."""
        slots = self._tiles.slots[self._tiles.slots != NO_TILE]
        for array in self._observations():
            array[slots] = 0
        self._tiles.release()
        self._fine_tiles.release()
        self.narrow_walls.release()


def ticks_in(time_s: float) -> int:
    return round(time_s / TICK_S)


def _mark_at(path_m: float) -> int:
    """Path mark of a sub-map, from 1 on; 0 before its beginning."""
    return min(1 + math.floor(path_m / MARK_M), MAX_MARK) if path_m >= 0.0 else 0


class SurfelSubmaps:
    """The sub-maps. Key frames go into two of them; after spacing_m the younger one takes over.

    A lost scan begins a detached segment at the predicted pose. The next scans are matched to the old map
    first; a match drops the segment. Otherwise they are matched to the segment, and the state stays lost,
    because its place is unknown. Scans that match neither begin another segment. Without a measurement of the
    motion the old map is not tried, because a match there may be ambiguous. The graph searches the map for
    the segment; once it is joined, scans are matched to it.
    """

    def __init__(self, config: SubmapsConfig) -> None:
        self._config = config
        self._pool = TilePool(
            (
                Layer((TILE_CELLS, TILE_CELLS, 2, COLUMNS), np.float32),
                Layer((TILE_CELLS, TILE_CELLS), np.float32),
                # Observations
                Layer((TILE_CELLS, TILE_CELLS), np.int8),
                Layer((TILE_CELLS, TILE_CELLS), np.uint16),
                Layer((TILE_CELLS, TILE_CELLS, 2), np.uint16),
            ),
            SUBMAP_POOL_TILES,
        )
        no_field = Layer((1, 1), np.float32)
        fine = Layer((TILE_CELLS, TILE_CELLS, 2, COLUMNS), np.float32)
        self._fine_pool = TilePool((fine, no_field), FINE_POOL_TILES)
        self._narrow_pool = narrow_wall_pool(SUBMAP_POOL_TILES)
        self._next_number = 0
        self._pair: list[Submap] = []
        self.detached: Submap | None = None  # the segment that is not joined to the map
        self._segment = self._joined_segment = 0  # number of the newest segment; of that in use
        # Without measured motion before the segment; above 0 the map is not used until the segment is joined.
        self.pause_s = 0.0
        self._misses = 0  # consecutive scans that matched neither the map nor the segment
        self._moved_m = self._turned = 0.0  # from the previous key frame; turned: in fields of view
        self._is_same_place = False  # as that of the previous key frame
        self._travelled_m = 0.0  # since the younger of the pair was begun
        self._last_keyframe: SE2 | None = None
        self._lasers: dict[str, int] = {}
        self._no_bias = np.zeros(1)  # of ranges: the points of a match are without it
        self._last_of: dict[str, SE2] = {}  # by laser: each sees another part of the scene

    @property
    def matched_to(self) -> Submap | None:
        """The sub-map that scans are matched to; None before the first scan."""
        return self._pair[0] if self._pair else None

    def detach(self, pause_s: float) -> None:
        """As Detachable.detach."""
        if not self._pair:
            return
        self.pause_s = pause_s
        if self.detached is not None:
            self.detached.release()
            self.detached = None

    def attach(self) -> None:
        """As Detachable.attach."""
        self.pause_s = 0.0

    def standing(self) -> Standing | None:
        """As CountsStanding.standing."""
        return None if self.matched_to is None else self.matched_to.standing()

    def join(self, segment: int) -> None:
        """Continue with a detached segment that the graph has joined, if it is the newest."""
        if self.detached is None or segment != self._segment:
            return
        for submap in self._pair:
            submap.release()
        self._pair, self.detached, self.pause_s = [self.detached], None, 0.0
        self._joined_segment = self._segment
        self._travelled_m = 0.0

    def laser_of(self, sensor: str) -> int:
        """Its number below LASERS, in the order of appearance; LASERS: one too many."""
        return self._lasers.setdefault(sensor, min(len(self._lasers), LASERS))

    def shorten(self, sensor: str, step_m: float) -> None:
        """Move the walls seen by a laser by a change of its constant range bias."""
        laser = self.laser_of(sensor)
        for submap in (*self._pair, self.detached):
            if submap is not None and laser < LASERS:
                submap.shorten(laser, step_m)

    @property
    def tile_count(self) -> int:
        return self._pool.used_count + self._fine_pool.used_count

    def insert(self, points: Points, match: Match) -> MapChange:
        if not len(points.xy_base):
            return MapChange()
        pose = match.motion.pose_odom_base
        if match.state == "lost" and self._pair:
            return self._insert_detached(points, match)
        if self.detached is not None:
            self.detached.release()
            self.detached = None
            self._begin_keyframes()
        if self._pair and not self._is_keyframe(points, pose, self._pair[0]):
            return MapChange(segment=self._joined_segment)
        self._advance(points, pose)
        if not self._pair or self._travelled_m >= self._config.spacing_m:
            self._begin_submap()
        error_left = self._error_left(match, self._pair[0])
        self._insert_keyframe(self._pair, points, pose)
        return MapChange(is_keyframe=True, error_left=error_left, segment=self._joined_segment)

    def _insert_detached(self, points: Points, match: Match) -> MapChange:
        """Insert a lost scan into the segment it was matched to, or begin one; few returns do neither."""
        if too_few(points):
            return MapChange(segment=self._joined_segment if self.detached is None else self._segment)
        pose = match.motion.pose_odom_base
        self._misses = 0 if match.measured is not None else self._misses + 1
        if self.detached is None or self._misses >= MAX_MISSES:
            if self.detached is not None:
                self.detached.release()
            self.detached = self.new_submap()
            self._begin_keyframes()
            self._misses = 0
            self._segment += 1
            self._advance(points, pose)
            self._insert_keyframe([self.detached], points, pose)
            return MapChange(is_keyframe=True, error_left=NEW_SEGMENT_ERROR, segment=self._segment)
        elif match.measured is None:
            return MapChange(segment=self._segment)
        if not self._is_keyframe(points, pose, self.detached):
            return MapChange(segment=self._segment)
        self._advance(points, pose)
        error_left = self._error_left(match, self.detached)
        self._insert_keyframe([self.detached], points, pose)
        return MapChange(is_keyframe=True, error_left=error_left, segment=self._segment)

    def _error_left(self, match: Match, submap: Submap) -> float:
        """Factor on the pose's error against the map after inserting a scan; [11].

        Inliers limit it, and in a young map its share of the scans from one place.
        """
        kept = math.exp(-self._moved_m / self._config.memory_m - self._turned)
        known = match.inlier_ratio
        if self._is_same_place and submap.scan_count < FIRST_SCANS:
            known = max(known, submap.scan_count / (submap.scan_count + 1))
        return max(min(kept, known), NEW_SEGMENT_ERROR)

    def _begin_keyframes(self) -> None:
        self._last_keyframe = None
        self._last_of.clear()

    def _is_keyframe(self, points: Points, pose: SE2, submap: Submap) -> bool:
        """Whether a scan is inserted: the sub-map is young, or the laser has moved far enough."""
        last = self._last_of.get(points.scan.sensor)
        if last is None or submap.scan_count < FIRST_SCANS:
            return True
        return pose.is_step_from(last, self._config.keyframe_distance_m, self._config.keyframe_turn_rad)

    def _advance(self, points: Points, pose: SE2) -> None:
        last, limits = self._last_keyframe, self._config
        step = limits.keyframe_distance_m, limits.keyframe_turn_rad
        self._is_same_place = last is not None and not pose.is_step_from(last, *step)
        self._last_of[points.scan.sensor] = pose
        self._moved_m = math.hypot(pose.x_m - last.x_m, pose.y_m - last.y_m) if last is not None else 0.0
        self._travelled_m += self._moved_m
        turned_rad = abs(wrap_angle(pose.theta_rad - last.theta_rad)) if last is not None else 0.0
        self._turned = turned_rad / abs(points.scan.angle_step_rad * len(points.scan.range_m))
        self._last_keyframe = pose

    def _insert_keyframe(self, submaps: list[Submap], points: Points, pose: SE2) -> None:
        _, on_walls, normals, has_posts = walls_seen(points, self._no_bias)
        posts = posts_of(points) if has_posts else None
        for submap in submaps:
            submap.insert(on_walls, normals, posts, pose, self.laser_of(points.scan.sensor))

    def new_submap(self) -> Submap:
        """An empty one, in no chain yet."""
        self._next_number += 1
        return Submap(self._next_number - 1, self._pool, self._fine_pool, self._narrow_pool, self._config)

    def _begin_submap(self) -> None:
        """Start a sub-map; of three the oldest is closed."""
        self._pair.append(self.new_submap())
        self._travelled_m = 0.0
        if len(self._pair) > 2:
            self._pair.pop(0).release()
