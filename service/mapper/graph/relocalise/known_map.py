"""All of the known map as something to be found in: where a piece may lie, and what speaks for each place."""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.kernels import occupancy
from service.kernels.beam_likelihood import (
    AGAINST_RATIO,
    FULL_RATIO,
    POINT_CELL_M,
    POINT_REACH,
    WALL_SIGMA_M,
    KnownGround,
    cells_with_walls,
    count_looks,
    splat_points,
)
from service.kernels.branch_and_bound import MaxPyramid, pool_levels, search_branch_and_bound
from service.kernels.facing_search import (
    DIRECTIONS,
    FULL_BYTE,
    LAYERS,
    FacingPyramid,
    search_facing,
    splat_facing,
)
from service.kernels.likeliest_pose import climb, evidence_of_beams
from service.kernels.loops import splat_field
from service.kernels.occupancy import OccupancyGrid, trace_scan
from service.kernels.surfels import SurfelGrid
from service.kernels.tiles import NO_TILE
from service.mapper.graph.model.candidate_submap import (
    LOOP_FIELD_SIGMA_M,
    LOOP_REACH_M,
    TRACED_EVERY,
    seen_by,
)
from service.mapper.graph.model.keyframe_list import KeyframeList
from service.mapper.graph.model.point_clouds import (
    CELL_M,
    CLOUD_POOL_TILES,
    Fit,
    PointCloud,
    SurfelSet,
    cover,
    joined,
)
from service.mapper.graph.model.seen_cloud import SeenCloud
from service.mapper.maps.occupancy import EVIDENCE
from service.mapper.maps.tiles import Layer, TileMap, TilePool
from service.mapper.matchers.window_search import thinned, window_around

COARSE_CELL_M, MAP_SEARCH_LEVELS = 0.2, 5  # blocks of 3.2 m, of which one place each is a candidate
HEADINGS = 210  # 0.03 rad apart: 0.22 m at LOOP_REACH_M, a cell
MAP_SEARCH_POINTS = 80
# Of a point where something may stand that the map has not seen, as on the back of a wall: it says nothing.
# Free ground contradicts, and scores 0.
MAP_UNKNOWN_LIKELIHOOD = 0.5
MIN_PLACE_SCORE = 0.45  # mean likelihood of the points
MAX_SCORE_DEFICIT = 0.2  # a place whose score is so far behind the best is no candidate
MAX_CANDIDATES = 240
REFINE_WINDOW = (0.3, 0.03, 0.006)  # m and rad about a candidate, in steps of so many rad
REFINING_POINTS = 150
CLIMB_STEPS, MIN_CLIMB_STEP = (
    np.array([0.06, 0.06, 0.012]),
    1.0 / 16.0,
)  # m, m, rad of a climb, and its last ones
ALONG_M, ALONG_STEP_M = 1.6, 0.1  # how far to both sides of a place along the walls others are looked for
ALONG_SHARE = 0.9  # of the points that lie on walls at a place must do so beside it
ON_MAP_RATIO = 0.5 * FULL_RATIO  # nats: a beam above it ends on what the map has there
# Nats that one wall or thing says at most. Buildings consist of straight walls, on new ground, too: the beams
# that end on one of them say one thing, where it stands. Walls that face the same way are so far apart.
WALLS_APART_M = 2.0
MAX_NATS_PER_WALL = math.log(WALLS_APART_M / (math.sqrt(2.0 * math.pi) * WALL_SIGMA_M))  # nats
SEEN_THROUGH_EVIDENCE = -10  # evidence of a cell: a beam passed, and none ended in it


@dataclass(frozen=True, slots=True)
class Weight:
    """What speaks for a cloud at a pose."""

    evidence: float  # nats: log-likelihood of its beams, less that on ground that nobody knows
    unexplained: float  # nats that are missing to a map that knows all that is seen; 0 or more
    against: float  # share of the beams that contradict the map, 0..1
    on_map: float  # share that ends on what the map has there, 0..1


@dataclass(frozen=True, slots=True, eq=False)
class Aligned:
    """A cloud aligned with the map."""

    fit: Fit
    weight: Weight


class KnownMap:
    """The points of the key frames `known` (K,), where the graph has them now."""

    def __init__(self, keyframes: KeyframeList, known: npt.NDArray[np.int64]) -> None:
        self.known = known
        clouds = [seen_by(keyframes, k).transformed(keyframes.map[k]) for k in known.tolist()]
        merged = joined(clouds)
        self._walls = SurfelSet(merged)
        few = _one_of_each_cell(merged)
        self._field = _field(few)
        self._ground = _ground(keyframes, known, clouds, merged.xy)
        self._facing = _facing_pyramid(few, self._ground)
        self._known_ground = _known_ground_of(keyframes, known, clouds, self._walls.grid(), self._ground)
        self._weighed = 0

    @property
    def area_m2(self) -> float:
        """Of the ground that it knows."""
        slots = self._ground.tiles.slots
        known = self._ground.evidence[slots[slots != NO_TILE]] != 0
        return float(known.sum()) * CELL_M * CELL_M

    def candidates(self, cloud: PointCloud) -> list[Floats]:
        """Where the cloud may lie: poses (3,) of its frame in the map, the likeliest first; at most
        MAX_CANDIDATES.
        """
        near = np.flatnonzero((cloud.xy**2).sum(axis=1) < LOOP_REACH_M**2)
        near = near[:: max(1, len(near) // MAP_SEARCH_POINTS)]
        xy, normals = cloud.xy[near], cloud.normals[near]
        places, _ = search_facing(xy, normals, self._facing, HEADINGS, MIN_PLACE_SCORE, MAX_SCORE_DEFICIT)
        order = np.argsort(-places[:, 3], kind="stable")[:MAX_CANDIDATES]
        return list(places[order, :3])

    def align(self, seen: SeenCloud, near: Floats, least: float = -math.inf) -> Aligned:
        """The cloud aligned with all walls there are, from a candidate. least: as of weigh."""
        window = window_around(near, REFINE_WINDOW[:2], self._field, REFINE_WINDOW[2])
        near = (seen.cloud.xy**2).sum(axis=1) < LOOP_REACH_M**2
        thin = thinned(seen.cloud.xy[near], REFINING_POINTS)
        found = search_branch_and_bound(thin, self._field, window, -math.inf)
        return self._aligned(seen, found.pose, least)

    def refine(self, seen: SeenCloud, aligned: Aligned) -> Aligned:
        """The likeliest pose near that of the alignment: walls alone lead astray where there are few."""
        pose = aligned.fit.pose.copy()
        evidence, count = climb(
            seen.cloud.xy,
            seen.cloud.normals,
            seen.sensors,
            seen.shares,
            pose,
            self._known_ground,
            self._weighed + 1,
            CLIMB_STEPS,
            MIN_CLIMB_STEP,
        )
        self._weighed += count
        again = self._aligned(seen, pose)
        if again.weight.evidence >= evidence:
            return again
        return Aligned(Fit(pose, again.fit.information, again.fit.share), self.weigh(seen, pose))

    def along(self, seen: SeenCloud, aligned: Aligned) -> list[Aligned]:
        """Where else the cloud fits beside a place, in the direction in which it is known worst."""
        of_pose = aligned.fit.information
        turning = np.outer(of_pose[:2, 2], of_pose[2, :2]) / max(float(of_pose[2, 2]), 1e-9)
        known = of_pose[:2, :2] - turning
        axis = np.append(np.linalg.eigh(known)[1][:, 0], 0.0)
        steps = np.arange(ALONG_STEP_M, ALONG_M + 0.5 * ALONG_STEP_M, ALONG_STEP_M)
        beside = [
            self._walls.align(seen.cloud, aligned.fit.pose + off_m * axis) for off_m in [*-steps, *steps]
        ]
        least = ALONG_SHARE * aligned.fit.share
        return [Aligned(fit, self.weigh(seen, fit.pose)) for fit in beside if fit.share >= least]

    def weigh(self, seen: SeenCloud, pose: Floats, least: float = -math.inf) -> Weight:
        """What speaks for a cloud at a pose (3,); of evidence below `least` no more than a bound."""
        shares = seen.shares
        evidence, at_end, along_beam = self._beam_evidence(seen, pose, least)
        merged = max(float(shares.sum()), 1e-9)
        against = float(shares @ (at_end + along_beam < AGAINST_RATIO)) / merged
        on_map = float(shares @ (at_end > ON_MAP_RATIO)) / merged
        return Weight(evidence, max(0.0, FULL_RATIO * merged - evidence), against, on_map)

    def structure(self, seen: SeenCloud, pose: Floats) -> float:
        """Nats that speak for a cloud at a pose (3,) against a building of which the map knows nothing: of
        each wall or thing once, MAX_NATS_PER_WALL at most for or against.
        """
        _, at_end, along_beam = self._beam_evidence(seen, pose)
        of_walls = np.bincount(seen.walls, seen.shares * at_end + along_beam)
        return float(np.clip(of_walls, -MAX_NATS_PER_WALL, MAX_NATS_PER_WALL).sum())

    def log_ratio_where_known(self, seen: SeenCloud, pose: Floats, rival: Floats) -> float:
        """Nats by which a pose (3,) is likelier than a rival, by the beams that end there on what the map
        knows: what it does not know may look as at the pose, where rooms of a building are alike.
        """
        _, at_end, along_beam = self._beam_evidence(seen, pose)
        _, at_end_of_rival, along_beam_of_rival = self._beam_evidence(seen, rival)
        is_known = (at_end_of_rival < 0.0) | (at_end_of_rival > ON_MAP_RATIO)
        ends = (seen.shares * (at_end - at_end_of_rival))[is_known]
        return float(ends.sum() + along_beam.sum() - along_beam_of_rival.sum())

    def _beam_evidence(
        self, seen: SeenCloud, pose: Floats, least: float = -math.inf
    ) -> tuple[float, Floats, Floats]:
        """The evidence of a cloud at a pose, and what end (N,) and way (N,) of each beam say, nats."""
        cloud = seen.cloud
        at_end, along_beam = np.empty(len(cloud.xy)), np.empty(len(cloud.xy))
        self._weighed += 1
        evidence = evidence_of_beams(
            cloud.xy,
            cloud.normals,
            seen.sensors,
            seen.shares,
            pose,
            self._known_ground,
            self._weighed,
            least,
            at_end,
            along_beam,
        )
        return evidence, at_end, along_beam

    def _aligned(self, seen: SeenCloud, pose: Floats, least: float = -math.inf) -> Aligned:
        fit = self._walls.align(seen.cloud, pose)
        return Aligned(fit, self.weigh(seen, fit.pose, least))


def _one_of_each_cell(cloud: PointCloud) -> PointCloud:
    """One point for each cell and direction in which walls face there: it says as much as all."""
    cells = np.floor(cloud.xy / CELL_M).astype(np.int64)
    low, high = cells.min(axis=0), cells.max(axis=0) + 1
    angle = np.arctan2(cloud.normals[:, 1], cloud.normals[:, 0])
    direction = np.floor(angle / (2.0 * np.pi) * DIRECTIONS + 0.5).astype(np.int64) % DIRECTIONS
    one_of = np.full((high[1] - low[1], high[0] - low[0], DIRECTIONS), -1, np.int32)
    one_of[cells[:, 1] - low[1], cells[:, 0] - low[0], direction] = np.arange(len(cells))
    few = one_of[one_of >= 0]
    return PointCloud(cloud.xy[few], cloud.normals[few], cloud.sigma_m[few])


def _facing_pyramid(cloud: PointCloud, ground: OccupancyGrid) -> FacingPyramid:
    block = 1 << (MAP_SEARCH_LEVELS - 1)
    low = np.floor(cloud.xy.min(axis=0) / COARSE_CELL_M).astype(np.int64) - 1 - block
    high = np.floor(cloud.xy.max(axis=0) / COARSE_CELL_M).astype(np.int64) + 2 + block
    columns, rows = (-(-(high - low) // block) * block).tolist()
    levels = np.zeros((LAYERS, MAP_SEARCH_LEVELS, rows, columns), np.uint8)
    pyramid = FacingPyramid(levels, int(low[1]), int(low[0]), COARSE_CELL_M)
    splat_facing(cloud.xy, cloud.normals, pyramid, LOOP_FIELD_SIGMA_M)
    unknown = np.uint8(FULL_BYTE * MAP_UNKNOWN_LIKELIHOOD) * ~_is_free(ground, pyramid)
    np.maximum(levels[:, 0], unknown, out=levels[:, 0])
    for layer in levels:
        pool_levels(layer, 0.0)
    return pyramid


def _is_free(ground: OccupancyGrid, pyramid: FacingPyramid) -> npt.NDArray[np.bool_]:
    """(H, W) cells of level 0 in which nothing stands, as far as the ground knows all of them."""
    rows, columns = pyramid.levels.shape[2:]
    times = round(COARSE_CELL_M / CELL_M)
    free = np.zeros((times * rows, times * columns), np.bool_)
    edge = occupancy.GRID_TILE_CELLS
    for i, j in np.argwhere(ground.tiles.slots != NO_TILE).tolist():
        row = (i + int(ground.tiles.origin[0])) * edge - times * pyramid.first_row
        column = (j + int(ground.tiles.origin[1])) * edge - times * pyramid.first_column
        of = ground.evidence[ground.tiles.slots[i, j]] <= SEEN_THROUGH_EVIDENCE
        low_row, low_column = max(row, 0), max(column, 0)
        part = of[low_row - row :, low_column - column :]
        to = free[low_row : row + edge, low_column : column + edge]
        to[:] = part[: to.shape[0], : to.shape[1]]
    coarser: npt.NDArray[np.bool_] = np.all(free.reshape(rows, times, columns, times), axis=(1, 3))
    return coarser


def _field(cloud: PointCloud) -> MaxPyramid:
    """Of one level: small windows are asked as a whole."""
    low = np.floor(cloud.xy.min(axis=0) / CELL_M).astype(np.int64) - 2
    high = np.floor(cloud.xy.max(axis=0) / CELL_M).astype(np.int64) + 3
    levels = np.zeros((1, high[1] - low[1], high[0] - low[0]), np.float32)
    splat_field(cloud.xy, int(low[1]), int(low[0]), CELL_M, LOOP_FIELD_SIGMA_M, levels[0])
    return MaxPyramid(levels, int(low[1]), int(low[0]), 0.0, 0.0, 1.0, CELL_M)


def _ground(
    keyframes: KeyframeList, known: npt.NDArray[np.int64], clouds: list[PointCloud], xy: Floats
) -> OccupancyGrid:
    cells = (occupancy.GRID_TILE_CELLS,) * 2
    tiles = TileMap(
        TilePool((Layer(cells, np.int8), Layer(cells, np.uint16), Layer((), np.uint8)), CLOUD_POOL_TILES)
    )
    cover(tiles, occupancy.GRID_TILE_BITS, np.concatenate((xy, keyframes.map[known, :2])))
    evidence, touched, changed = tiles.pool.arrays
    ground = OccupancyGrid(tiles.index(), evidence, touched, changed, CELL_M)  # type: ignore[arg-type]
    for number in range(0, len(known), TRACED_EVERY):
        ends = clouds[number].xy
        sensor = _sensor_of(keyframes, int(known[number]))
        if len(ends):
            scan_number = np.uint16(number // TRACED_EVERY % 65_535 + 1)
            trace_scan(ends, sensor, np.zeros(3), ground, EVIDENCE, LOOP_REACH_M, scan_number)
    return ground


def _known_ground_of(
    keyframes: KeyframeList,
    known: npt.NDArray[np.int64],
    clouds: list[PointCloud],
    walls: SurfelGrid,
    ground: OccupancyGrid,
) -> KnownGround:
    looked = np.zeros(walls.surfels.shape[:4], np.float32)
    for number in range(0, len(known), TRACED_EVERY):
        sensor = _sensor_of(keyframes, int(known[number]))
        count_looks(clouds[number].xy, sensor, walls, float(TRACED_EVERY), looked)
    xy = joined(clouds).xy
    low = np.floor(xy.min(axis=0) / POINT_CELL_M).astype(np.int64) - POINT_REACH
    high = np.floor(xy.max(axis=0) / POINT_CELL_M).astype(np.int64) + POINT_REACH + 1
    points = np.zeros((high[1] - low[1], high[0] - low[0]), np.uint8)
    splat_points(xy, int(low[1]), int(low[0]), points)
    visited = np.zeros(walls.surfels.shape[:3], np.int32)
    return KnownGround(
        walls,
        cells_with_walls(walls),
        looked,
        ground,
        SEEN_THROUGH_EVIDENCE,
        points,
        int(low[1]),
        int(low[0]),
        visited,
    )


def _sensor_of(keyframes: KeyframeList, k: int) -> Floats:
    """(2,) m: where the beams of a key frame begin, in the map."""
    at: Floats = se2.points_from(keyframes.map[k], np.array([keyframes.thinned[k].sensor_xy_m]))[0]
    return at
