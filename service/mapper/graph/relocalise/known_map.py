"""The known map for place recognition: candidate poses of a query, and their evidence."""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.geometry.poses import Floats
from service.kernels import occupancy
from service.kernels.beam_likelihood import (
    MAX_LOG_RATIO,
    MIN_LOG_RATIO,
    POINT_CELL_M,
    POINT_REACH,
    WALL_SIGMA_M,
    KnownGround,
    cells_with_walls,
    count_beams_through,
    splat_points,
)
from service.kernels.branch_and_bound import MaxPyramid, search_branch_and_bound
from service.kernels.facing_search import (
    DIRECTIONS,
    LAYERS,
    SUMMED_AT_ONCE,
    FacingPyramid,
    search_facing,
    splat_facing,
)
from service.kernels.loops import splat_field
from service.kernels.maximum_likelihood_pose import evidence_of_beams, hill_climb
from service.kernels.occupancy import OccupancyGrid
from service.kernels.surfels import SurfelGrid
from service.kernels.tiles import NO_TILE
from service.mapper.graph.model.candidate_submap import (
    LOOP_FIELD_SIGMA_M,
    LOOP_REACH_M,
    TRACED_EVERY,
    SeenCloud,
    free_space,
    observed_by,
)
from service.mapper.graph.model.keyframe_list import KeyframeList
from service.mapper.graph.model.point_clouds import CELL_M, Fit, PointCloud, SurfelSet, joined
from service.mapper.maps.occupancy import EVIDENCE
from service.mapper.matchers.window_search import SEARCH_BEAMS, thinned, window_around

COARSE_CELL_M, MAP_SEARCH_LEVELS = 0.2, 5  # blocks of 3.2 m, each with one candidate
HEADINGS = 210  # 0.03 rad apart: 0.22 m at LOOP_REACH_M, a cell
MAP_SEARCH_POINTS = 10 * SUMMED_AT_ONCE
SAMPLING_NATS = 0.15  # a beam: error of the evidence of so few points, in so coarse cells
# Margin by which the evidence of the best place must exceed every other (nats, by
# service.kernels.beam_likelihood); plus a share of its unexplained evidence, since then the true place may
# fit worse than one that looks alike.
MIN_MARGIN_NATS, UNEXPLAINED_SHARE = 20.0, 0.5
MAX_CANDIDATES = 240
REFINE_WINDOW = (0.3, 0.03, 0.006)  # m, rad around a candidate; step in rad
# m, m, rad of the first steps of a climb, and factor of the last ones.
CLIMB_STEPS, MIN_CLIMB_STEP = np.array([0.06, 0.06, 0.012]), 1.0 / 16.0
ALONG_SHARE = 0.9  # of the inlier ratio at the place, for a place beside it
ON_MAP_RATIO = 0.5 * MAX_LOG_RATIO  # nats: a beam above it ends on a mapped object
# Limit of the evidence of one wall or object, nats. Buildings have straight walls on new ground, too, so all
# beams on a wall give one measurement: its offset. Parallel walls are this far apart.
WALLS_APART_M = 2.0
MAX_NATS_PER_WALL = math.log(WALLS_APART_M / (math.sqrt(2.0 * math.pi) * WALL_SIGMA_M))  # nats
MAX_QUERY = 12  # key frames of a query
# Least share of the beams on the map, and on walls of those on known ground. From new viewpoints, and near
# new ground, much of the query is unmapped.
MIN_ON_MAP, MIN_AGREEING = 0.3, 0.90


def margin_of(unexplained: float) -> float:
    """Nats by which the evidence of a place must exceed that of others."""
    return MIN_MARGIN_NATS + UNEXPLAINED_SHARE * unexplained


def fits(on_map: float, against: float) -> bool:
    """Whether enough of the beams lie on the map, and few contradict it. Shares, 0..1."""
    return on_map >= MIN_ON_MAP and on_map >= MIN_AGREEING * (on_map + against)


def winning_nats(mass: float) -> float:
    """Least evidence of a cloud that exceeds unmapped ground by the margin, nats."""
    return margin_of(MAX_LOG_RATIO * mass) / (1.0 + UNEXPLAINED_SHARE)


def rival_nats(best: float, mass: float) -> float:
    """Largest evidence that a best place exceeds by the margin, nats."""
    return best - margin_of(max(0.0, MAX_LOG_RATIO * mass - best))


@dataclass(frozen=True, slots=True)
class PlaceScore:
    """Evidence of a cloud at a pose."""

    evidence: float  # nats: log-likelihood ratio of its beams to unknown ground
    unexplained: float  # nats missing to a map that explains all beams; 0 or more
    against: float  # share of the beams that contradict the map, 0..1
    on_map: float  # share of the beams that end on mapped objects, 0..1


@dataclass(frozen=True, slots=True, eq=False)
class Aligned:
    """A cloud aligned with the map."""

    fit: Fit
    score: PlaceScore


class KnownMap:
    """Map of the key frames `known` (K,), at their current poses."""

    def __init__(self, keyframes: KeyframeList, known: npt.NDArray[np.int64]) -> None:
        self.known = known
        seen = [observed_by(keyframes, k, keyframes.map[k]) for k in known.tolist()]
        merged = joined([cloud for cloud, _ in seen])
        self._walls = SurfelSet(merged)
        few = _one_of_each_cell(merged)
        self._field = _field(few)
        self._ground = free_space(seen)
        self._facing = _facing_pyramid(few, self._ground)
        self._known_ground = _known_ground_of(seen, merged.xy, self._walls.grid(), self._ground)
        self._evaluated = 0

    @property
    def area_m2(self) -> float:
        """Area of known ground."""
        slots = self._ground.tiles.slots
        known = self._ground.evidence[slots[slots != NO_TILE]] != 0
        return float(known.sum()) * CELL_M * CELL_M

    def candidates(self, seen: SeenCloud, least: float) -> Floats:
        """Candidate poses of the cloud in the map that may have an evidence of `least`, and an upper bound of
        it: (C, 4) m, m, rad, nats, the most likely first; at most MAX_CANDIDATES.
        """
        cloud = seen.cloud
        near = np.flatnonzero((cloud.xy**2).sum(axis=1) < LOOP_REACH_M**2)
        if not len(near):
            return np.empty((0, 4))
        weights = np.cumsum(seen.shares[near])
        mass = float(weights[-1])
        far_nats = MAX_LOG_RATIO * (seen.mass - mass)  # at most
        at = (np.arange(MAP_SEARCH_POINTS) + 0.5) / MAP_SEARCH_POINTS * mass
        # The points that are summed first are of all sides of the query.
        near = near[np.searchsorted(weights, at)].reshape(SUMMED_AT_ONCE, -1).T.ravel()
        least_mean = (least - far_nats) / mass - SAMPLING_NATS
        places, _ = search_facing(cloud.xy[near], cloud.normals[near], self._facing, HEADINGS, least_mean)
        places[:, 3] = mass * (places[:, 3] + SAMPLING_NATS) + far_nats
        first: Floats = places[np.argsort(-places[:, 3], kind="stable")[:MAX_CANDIDATES]]
        return first

    def align(
        self,
        seen: SeenCloud,
        near: Floats,
        least: float = -math.inf,
        window: tuple[float, float] = REFINE_WINDOW[:2],
    ) -> Aligned:
        """The cloud aligned with all walls, from a candidate pose.

        least    as of weigh
        window   m, rad: half the window that is searched about the candidate
        """
        poses = window_around(near, window, self._field, REFINE_WINDOW[2])
        is_near = (seen.cloud.xy**2).sum(axis=1) < LOOP_REACH_M**2
        thin = thinned(seen.cloud.xy[is_near], SEARCH_BEAMS)
        found = search_branch_and_bound(thin, self._field, poses, -math.inf)
        return self._aligned(seen, found.pose, least)

    def refine(self, seen: SeenCloud, aligned: Aligned) -> Aligned:
        """The pose of highest evidence near an alignment, which few walls alone do not determine."""
        pose = aligned.fit.pose.copy()
        evidence, count = hill_climb(
            seen.cloud.xy,
            seen.cloud.normals,
            seen.sensors,
            seen.shares,
            pose,
            self._known_ground,
            self._evaluated + 1,
            CLIMB_STEPS,
            MIN_CLIMB_STEP,
        )
        self._evaluated += count
        again = self._aligned(seen, pose)
        if again.score.evidence >= evidence:
            return again
        return Aligned(Fit(pose, again.fit.information, again.fit.share), self.score(seen, pose))

    def along(self, seen: SeenCloud, aligned: Aligned, evidence: float = -math.inf) -> list[Aligned]:
        """Alignments beside a place, each cell along its least certain direction, up to half a block of the
        search away. evidence: `least` of score.
        """
        of_pose = aligned.fit.information
        turning = np.outer(of_pose[:2, 2], of_pose[2, :2]) / max(float(of_pose[2, 2]), 1e-9)
        known = of_pose[:2, :2] - turning
        axis = np.append(np.linalg.eigh(known)[1][:, 0], 0.0)
        steps = np.arange(CELL_M, COARSE_CELL_M * (1 << MAP_SEARCH_LEVELS - 2) + 0.5 * CELL_M, CELL_M)
        beside = [
            self._walls.align(seen.cloud, aligned.fit.pose + off_m * axis) for off_m in [*-steps, *steps]
        ]
        least = ALONG_SHARE * aligned.fit.share
        return [Aligned(fit, self.score(seen, fit.pose, evidence)) for fit in beside if fit.share >= least]

    def score(self, seen: SeenCloud, pose: Floats, least: float = -math.inf) -> PlaceScore:
        """Evidence of a cloud at a pose (3,); below `least` only an upper bound."""
        shares = seen.shares
        evidence, at_end, along_beam = self._beam_evidence(seen, pose, least)
        against = float(shares @ (at_end + along_beam < MIN_LOG_RATIO)) / seen.mass
        on_map = float(shares @ (at_end > ON_MAP_RATIO)) / seen.mass
        return PlaceScore(evidence, max(0.0, MAX_LOG_RATIO * seen.mass - evidence), against, on_map)

    def structure(self, seen: SeenCloud, pose: Floats) -> float:
        """Log-likelihood ratio of a pose (3,) to an unmapped building, nats: each wall or object counts once,
        within +-MAX_NATS_PER_WALL.
        """
        _, at_end, along_beam = self._beam_evidence(seen, pose)
        of_walls = np.bincount(seen.walls, seen.shares * at_end + along_beam)
        return float(np.clip(of_walls, -MAX_NATS_PER_WALL, MAX_NATS_PER_WALL).sum())

    def log_ratio_where_known(self, seen: SeenCloud, pose: Floats, rival: Floats) -> float:
        """Log-ratio of a pose (3,) to a rival pose, nats, by beams on ground known at the rival: unknown
        ground there may look the same where rooms are alike.
        """
        _, at_end, along_beam = self._beam_evidence(seen, pose)
        _, at_end_of_rival, along_beam_of_rival = self._beam_evidence(seen, rival)
        is_known = (at_end_of_rival < 0.0) | (at_end_of_rival > ON_MAP_RATIO)
        ends = (seen.shares * (at_end - at_end_of_rival))[is_known]
        return float(ends.sum() + along_beam.sum() - along_beam_of_rival.sum())

    def _beam_evidence(
        self, seen: SeenCloud, pose: Floats, least: float = -math.inf
    ) -> tuple[float, Floats, Floats]:
        """Evidence of a cloud at a pose, and its terms at the end (N,) and along (N,) each beam, nats."""
        cloud = seen.cloud
        at_end, along_beam = np.empty(len(cloud.xy)), np.empty(len(cloud.xy))
        self._evaluated += 1
        evidence = evidence_of_beams(
            cloud.xy,
            cloud.normals,
            seen.sensors,
            seen.shares,
            pose,
            self._known_ground,
            self._evaluated,
            least,
            at_end,
            along_beam,
        )
        return evidence, at_end, along_beam

    def _aligned(self, seen: SeenCloud, pose: Floats, least: float = -math.inf) -> Aligned:
        fit = self._walls.align(seen.cloud, pose)
        return Aligned(fit, self.score(seen, fit.pose, least))


def _one_of_each_cell(cloud: PointCloud) -> PointCloud:
    """One point per cell and direction of the normal, which carries the same information as all."""
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
    levels = np.empty((LAYERS, MAP_SEARCH_LEVELS, rows, columns), np.int8)
    pyramid = FacingPyramid(levels, int(low[1]), int(low[0]), COARSE_CELL_M)
    splat_facing(cloud.xy, cloud.normals, _is_free(ground, pyramid), pyramid, LOOP_FIELD_SIGMA_M)
    return pyramid


def _is_free(ground: OccupancyGrid, pyramid: FacingPyramid) -> npt.NDArray[np.bool_]:
    """(H, W) cells of level 0 that are entirely observed as free."""
    rows, columns = pyramid.levels.shape[2:]
    times = round(COARSE_CELL_M / CELL_M)
    free = np.zeros((times * rows, times * columns), np.bool_)
    edge = occupancy.GRID_TILE_CELLS
    for i, j in np.argwhere(ground.tiles.slots != NO_TILE).tolist():
        row = (i + int(ground.tiles.origin[0])) * edge - times * pyramid.first_row
        column = (j + int(ground.tiles.origin[1])) * edge - times * pyramid.first_column
        of = ground.evidence[ground.tiles.slots[i, j]] <= EVIDENCE.miss
        low_row, low_column = max(row, 0), max(column, 0)
        part = of[low_row - row :, low_column - column :]
        to = free[low_row : row + edge, low_column : column + edge]
        to[:] = part[: to.shape[0], : to.shape[1]]
    coarser: npt.NDArray[np.bool_] = np.all(free.reshape(rows, times, columns, times), axis=(1, 3))
    return coarser


def _field(cloud: PointCloud) -> MaxPyramid:
    """A field of one level: small windows are searched exhaustively."""
    low = np.floor(cloud.xy.min(axis=0) / CELL_M).astype(np.int64) - 2
    high = np.floor(cloud.xy.max(axis=0) / CELL_M).astype(np.int64) + 3
    levels = np.zeros((1, high[1] - low[1], high[0] - low[0]), np.float32)
    splat_field(cloud.xy, int(low[1]), int(low[0]), CELL_M, LOOP_FIELD_SIGMA_M, levels[0])
    return MaxPyramid(levels, int(low[1]), int(low[0]), 0.0, 0.0, 1.0, CELL_M)


def _known_ground_of(
    seen: list[tuple[PointCloud, Floats]], xy: Floats, walls: SurfelGrid, ground: OccupancyGrid
) -> KnownGround:
    through_count = np.zeros(walls.surfels.shape[:4], np.float32)
    for cloud, sensor in seen[::TRACED_EVERY]:
        count_beams_through(cloud.xy, sensor, walls, float(TRACED_EVERY), through_count)
    low = np.floor(xy.min(axis=0) / POINT_CELL_M).astype(np.int64) - POINT_REACH
    high = np.floor(xy.max(axis=0) / POINT_CELL_M).astype(np.int64) + POINT_REACH + 1
    points = np.zeros((high[1] - low[1], high[0] - low[0]), np.uint8)
    splat_points(xy, int(low[1]), int(low[0]), points)
    visited = np.zeros(walls.surfels.shape[:3], np.int32)
    return KnownGround(
        walls,
        cells_with_walls(walls),
        through_count,
        ground,
        EVIDENCE.miss,
        points,
        int(low[1]),
        int(low[0]),
        visited,
    )
