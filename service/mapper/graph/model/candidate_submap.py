"""A sub-map for loop search: surfels, free space, and a likelihood field; key frames as a query."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.geometry.se2 import wrap_angle
from service.kernels import occupancy
from service.kernels.branch_and_bound import MaxPyramid, padding_cells, pool_levels, search_branch_and_bound
from service.kernels.loops import fill_unknown, share_in_free_space, splat_field
from service.kernels.occupancy import OccupancyGrid, trace_scan
from service.kernels.wall_groups import group_by_wall
from service.mapper.graph.model.keyframe_list import KeyframeList
from service.mapper.graph.model.point_clouds import (
    CELL_M,
    CLOUD_POOL_TILES,
    Fit,
    PointCloud,
    SurfelSet,
    cloud_with_noise,
    cover,
    joined,
)
from service.mapper.maps.occupancy import EVIDENCE, FREE_EVIDENCE
from service.mapper.maps.tiles import Layer, TileMap, TilePool
from service.mapper.matchers.window_search import SEARCH_BEAMS, thinned, window_around

LOOP_FIELD_SIGMA_M = 0.12  # of the likelihood field: a cell and the remaining drift
LOOP_SEARCH_LEVELS = 7
LOOP_REACH_M = 15.0  # farther points are ignored: they are few, and sensitive to rotation
# Likelihood of a point on ground that the sub-map has not observed: below that of a point on a wall, so that
# known ground is preferred.
LOOP_UNKNOWN_LIKELIHOOD = 0.7
LIKELIHOOD_STEP = 1.0 / 255.0  # of a cell of the pyramid, a byte
MIN_LOOP_SCORE = 0.5  # least mean likelihood of a search result: half of the points lie on walls
# [22] Gate for noise in the information of a loop: the largest of the loops along 30 m of a corridor, one
# each 2 m.
CHANCE_CHI2 = 2.0 * math.log(30.0 / 2.0)
REACH_SIGMAS = 3.5  # of the drift between two passes: half a window
TRACED_EVERY = 3  # key frames: neighbours observe the same free space
# Distant walls distinguish places that are alike nearby. At this range a heading error of 0.04 deg moves a
# point by the noise of a wall.
EVIDENCE_RANGE_M = 30.0
SEEN_CELL_M = 0.2  # points of several key frames in a cell of this size share their weight


def cloud_of(keyframes: KeyframeList, members: Iterable[int], reference: int) -> PointCloud:
    """Points of key frames in the frame of `reference`, placed by odometry."""
    odom = keyframes.odom
    return joined([observed_by(keyframes, k, se2.between(odom[reference], odom[k]))[0] for k in members])


def observed_by(
    keyframes: KeyframeList, k: int, pose: Floats, reach_m: float = LOOP_REACH_M
) -> tuple[PointCloud, Floats]:
    """The points of a key frame within reach_m, and the origin of its beams, (2,) m, in the frame in which it
    has a pose (3,).
    """
    kept = keyframes.thinned[k]
    near = (kept.xy_base * kept.xy_base).sum(axis=1) < reach_m * reach_m
    xy, normals = kept.xy_base[near].astype(np.float64), kept.normals[near].astype(np.float64)
    cloud = cloud_with_noise(xy, normals, float(keyframes.range_sigma_m[k]))
    return cloud.transformed(pose), se2.points_from(pose, np.array(kept.sensor_xy_m))


class CandidateSubmap:
    """Key frames around `reference`, in its frame, placed by odometry.

    poses   (N, 3) of all key frames, to place them by instead: of the graph, for members of several passes
    """

    def __init__(
        self, keyframes: KeyframeList, members: Iterable[int], reference: int, poses: Floats | None = None
    ) -> None:
        poses = keyframes.odom if poses is None else poses
        self.reference = reference
        self.members = list(members)
        self._space: OccupancyGrid | None = None
        self._pyramid: MaxPyramid | None = None
        # For the free space alone.
        origin = poses[reference]
        self._seen = [observed_by(keyframes, k, se2.between(origin, poses[k])) for k in self.members]
        merged = joined([cloud for cloud, _ in self._seen])
        self._xy = merged.xy
        self._surfels = SurfelSet(merged)

    def search(
        self,
        cloud: PointCloud,
        pose: Floats,
        reach_m: float,
        reach_rad: float,
        least: float,
        step_rad: float = CELL_M / 10.0,
    ) -> Floats | None:
        """Best pose of the cloud in a window around a pose; None if its score is below `least`."""
        if not len(cloud.xy) or not len(self._xy):
            return None
        window = window_around(pose, (reach_m, reach_rad), self.pyramid(), step_rad)
        found = search_branch_and_bound(thinned(cloud.xy, SEARCH_BEAMS), self.pyramid(), window, least)
        return found.pose if found.score >= least else None

    def align(self, cloud: PointCloud, pose: Floats) -> Fit:
        """The cloud aligned with the surfels, from a nearby pose."""
        return self._surfels.align_with_shared_errors(cloud, pose, CHANCE_CHI2)

    def align_about(
        self, cloud: PointCloud, pose: Floats, expected: Floats, reach_m: float, reach_rad: float
    ) -> Fit:
        """Like `align`; along directions that walls leave open the expected pose applies.

        expected             pose (3,) at the centre of the search window
        reach_m, reach_rad   half of the window: REACH_SIGMAS of the expected pose

        The search picks any value along an open direction, up to 1.5 m off in a corridor, where the
        linearisation does not hold. The expected pose only moves the starting point of the alignment; it is
        not in the fit.
        """
        fit = self.align(cloud, pose)
        sigmas = np.array([reach_m, reach_m, reach_rad]) / REACH_SIGMAS
        prior = np.diag(sigmas**-2)
        off = expected - fit.pose
        off[2] = wrap_angle(off[2])
        return self.align(cloud, fit.pose + np.linalg.solve(fit.information + prior, prior @ off))

    def against(self, cloud: PointCloud, pose: Floats) -> float:
        """Share of the points in free space of the sub-map, 0..1."""
        return float(share_in_free_space(cloud.xy, pose, self._free(), FREE_EVIDENCE))

    def pyramid(self) -> MaxPyramid:
        if self._pyramid is None:
            pad = padding_cells(LOOP_SEARCH_LEVELS)
            low = np.floor(self._xy.min(axis=0) / CELL_M).astype(np.int64) - 2 - pad
            high = np.floor(self._xy.max(axis=0) / CELL_M).astype(np.int64) + 3
            row, column = int(low[1]), int(low[0])
            field = np.zeros((high[1] - low[1], high[0] - low[0]), np.float32)
            splat_field(self._xy, row, column, CELL_M, LOOP_FIELD_SIGMA_M, field)
            fill_unknown(field, row, column, self._free(), LOOP_UNKNOWN_LIKELIHOOD)
            levels = np.empty((LOOP_SEARCH_LEVELS, *field.shape), np.uint8)
            levels[0] = np.rint(field / LIKELIHOOD_STEP)
            unknown = float(np.rint(LOOP_UNKNOWN_LIKELIHOOD / LIKELIHOOD_STEP))
            pool_levels(levels, unknown)
            self._pyramid = MaxPyramid(levels, row, column, unknown, 0.0, LIKELIHOOD_STEP, CELL_M)
        return self._pyramid

    def _free(self) -> OccupancyGrid:
        if self._space is None:
            self._space = free_space(self._seen)
            self._seen = []
        return self._space


def free_space(seen: Sequence[tuple[PointCloud, Floats]]) -> OccupancyGrid:
    """Ground that key frames observed, each as of observed_by."""
    cells = (occupancy.GRID_TILE_CELLS,) * 2
    tiles = TileMap(
        TilePool((Layer(cells, np.int8), Layer(cells, np.uint16), Layer((), np.uint8)), CLOUD_POOL_TILES)
    )
    extent = np.concatenate([np.vstack((cloud.xy, sensor)) for cloud, sensor in seen])
    cover(tiles, occupancy.GRID_TILE_BITS, extent)
    evidence, touched, changed = tiles.pool.arrays
    ground = OccupancyGrid(tiles.index(), evidence, touched, changed, CELL_M)  # type: ignore[arg-type]
    for number, (cloud, sensor) in enumerate(seen[::TRACED_EVERY]):
        if len(cloud.xy):
            scan_number = np.uint16(number % np.iinfo(np.uint16).max + 1)
            trace_scan(cloud.xy, sensor, np.zeros(3), ground, EVIDENCE, LOOP_REACH_M, scan_number)
    return ground


@dataclass(frozen=True, slots=True, eq=False)
class SeenCloud:
    """Points, and the beams that end in them.

    sensors   (N, 2) m   origin of each beam, in the frame of the cloud
    shares    (N,)       weight of each point: one over the number of key frames that saw its cell
    walls     (N,)       number of the wall or object that each point lies on
    """

    cloud: PointCloud
    sensors: Floats
    shares: Floats
    walls: npt.NDArray[np.int64]

    @property
    def mass(self) -> float:
        """Sum of the shares."""
        return max(float(self.shares.sum()), 1e-9)


def seen_cloud(keyframes: KeyframeList, members: Sequence[int], reference: int) -> SeenCloud:
    """Query of key frames, placed by odometry, in the frame of `reference`."""
    odom = keyframes.odom
    clouds, sensors, number = [], [], []
    for n, k in enumerate(members):
        cloud, sensor = observed_by(keyframes, k, se2.between(odom[reference], odom[k]), EVIDENCE_RANGE_M)
        count = len(cloud.xy)
        clouds.append(cloud)
        sensors.append(np.tile(sensor, (count, 1)))
        number.append(np.full(count, n))
    cloud = joined(clouds)
    walls = np.empty(len(cloud.xy), np.int64)
    group_by_wall(cloud.xy, cloud.normals, cloud.sigma_m, walls)
    return SeenCloud(cloud, np.concatenate(sensors), _shares(cloud.xy, np.concatenate(number)), walls)


def _shares(xy: Floats, keyframe: np.ndarray) -> Floats:
    """(N,) one over the number of key frames with a point in the cell of each point."""
    _, cell = np.unique(np.floor(xy / SEEN_CELL_M).astype(np.int64), axis=0, return_inverse=True)
    cell = cell.reshape(-1)
    several = int(keyframe.max(initial=0)) + 1
    seen = np.unique(cell * several + keyframe)
    shares: Floats = 1.0 / np.bincount(seen // several)[cell]
    return shares
