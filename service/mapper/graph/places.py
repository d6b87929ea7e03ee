"""A stretch of the way as something to be found again: surfels, free space, and a field to search in."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.geometry import poses as se2
from service.geometry.grid import tiles_of
from service.kernels import occupancy, surfels
from service.kernels.likelihood_search import (
    MaxPyramid,
    SearchWindow,
    padding_cells,
    pool_levels,
    search_branch_and_bound,
)
from service.kernels.loops import align_surfels, share_in_free_space, splat_field
from service.kernels.match import MatchSettings
from service.kernels.occupancy import Evidence, OccupancyGrid, trace_scan
from service.kernels.surfels import SurfelGrid, insert_surfels
from service.mapper.graph.keyframes import Chain, Floats
from service.mapper.maps.tiles import Layer, TileMap, TilePool

CELL_M = 0.10
FIELD_SIGMA_M = 0.12
LEVELS = 7
REACH_M = 15.0  # points beyond are not asked: they are few, and a small turn moves them far
COUNT_LIMIT = 50.0
EVIDENCE = Evidence(24, -10, -70, 70)
FREE = -20  # two misses and no hit
SEARCH_POINTS = 200
TRACED_EVERY = 3  # key frames of a place: neighbours see the same free space
POOL_TILES = 4096
SETTINGS = MatchSettings(
    sigma_m=0.05,
    cauchy_m=0.10,
    least_normal_cosine=0.6,
    young_count=3.0,
    iterations=15,
    deskew_rounds=0,
    inlier_m=0.10,
    coarse_sigma=0.3,
    coarse_beams=180,
    coarse_iterations=0,
    settled_m=0.0005,
    settled_rad=0.0001,
    blind_sigma_m=0.0,
    covariance_scale=2.0,
)


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """Points of several key frames in the frame of one of them."""

    xy: Floats  # (N, 2) m
    normals: Floats  # (N, 3)


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """How a cloud lies on a place."""

    pose: Floats  # (3,) of the cloud's frame in the place's
    hessian: Floats  # (3, 3) in the axes of the place
    share: float  # of the points asked that lie on its surfels


def cloud_of(chain: Chain, members: Iterable[int], reference: int) -> Cloud:
    """Key frames as odometry lays them, in the frame of `reference`."""
    xys, normals = [], []
    for k in members:
        kept = chain.kept[k]
        near = (kept.xy_base * kept.xy_base).sum(axis=1) < REACH_M * REACH_M
        pose = se2.between(chain.odom[reference], chain.odom[k])
        xys.append(se2.points_from(pose, kept.xy_base[near].astype(np.float64)))
        normals.append(_turned(kept.normals[near].astype(np.float64), pose[2]))
    return Cloud(np.concatenate(xys), np.concatenate(normals))


class Place:
    """Key frames around one, `reference`, in whose frame all lies, put together by odometry."""

    def __init__(self, chain: Chain, members: Iterable[int], reference: int) -> None:
        self.reference = reference
        self.members = list(members)
        self._surfels = TileMap(
            TilePool((Layer((surfels.TILE_CELLS,) * 2 + (2, 5), np.float32),), POOL_TILES)
        )
        cells = (occupancy.TILE_CELLS,) * 2
        self._space = TileMap(
            TilePool((Layer(cells, np.int8), Layer(cells, np.uint16), Layer((), np.uint8)), POOL_TILES)
        )
        self._pyramid: MaxPyramid | None = None
        self._clouds = [cloud_of(chain, [k], reference) for k in self.members]
        self._sensors = [
            se2.points_from(
                se2.between(chain.odom[reference], chain.odom[k]), np.array(chain.kept[k].sensor_xy_m)
            )
            for k in self.members
        ]
        self._xy = np.concatenate([cloud.xy for cloud in self._clouds])
        self._knows_space = False
        if len(self._xy):
            self._cover(self._surfels, surfels.TILE_BITS, self._xy)
            normals = np.concatenate([cloud.normals for cloud in self._clouds])
            insert_surfels(self._xy, normals, np.zeros(3), self._grid(), COUNT_LIMIT)

    def search(
        self, cloud: Cloud, pose: Floats, reach_m: float, reach_rad: float, least: float
    ) -> Floats | None:
        """Where the cloud lies best within a window about a pose; None where nowhere well enough."""
        if not len(cloud.xy) or not len(self._xy):
            return None
        thin = cloud.xy[:: max(1, len(cloud.xy) // SEARCH_POINTS)]
        step_rad = CELL_M / 10.0
        half = math.ceil(reach_m / CELL_M)
        window = SearchWindow(pose, half, half, math.ceil(reach_rad / step_rad), step_rad)
        weights = np.ones(len(thin), np.float32)
        found = search_branch_and_bound(thin, weights, self.pyramid(), window, least)
        return found.pose if found.score >= least else None

    def align(self, cloud: Cloud, pose: Floats) -> Fit:
        """The cloud laid on the surfels, from a pose near enough."""
        aligned, hessian = pose.copy(), np.zeros((3, 3))
        used, inliers = align_surfels(cloud.xy, cloud.normals, self._grid(), SETTINGS, aligned, hessian)
        return Fit(aligned, hessian, inliers / used if used else 0.0)

    def against(self, cloud: Cloud, pose: Floats) -> float:
        """Share of the points that would lie in free space of the place, 0..1."""
        if not self._knows_space:
            self._trace()
        return float(share_in_free_space(cloud.xy, pose, self._free(), FREE))

    def pyramid(self) -> MaxPyramid:
        if self._pyramid is None:
            pad = padding_cells(LEVELS)
            low = np.floor(self._xy.min(axis=0) / CELL_M).astype(np.int64) - 2 - pad
            high = np.floor(self._xy.max(axis=0) / CELL_M).astype(np.int64) + 3
            levels = np.zeros((LEVELS, high[1] - low[1], high[0] - low[0]), np.float32)
            splat_field(self._xy, int(low[1]), int(low[0]), CELL_M, FIELD_SIGMA_M, levels[0])
            pool_levels(levels, 0.0)
            self._pyramid = MaxPyramid(levels, int(low[1]), int(low[0]), 0.0, 0.0, 1.0, CELL_M)
        return self._pyramid

    def _trace(self) -> None:
        self._knows_space = True
        self._cover(self._space, occupancy.TILE_BITS, np.concatenate((self._xy, self._sensors)))
        for number in range(0, len(self._clouds), TRACED_EVERY):
            cloud, sensor = self._clouds[number], self._sensors[number]
            if len(cloud.xy):
                trace_scan(
                    cloud.xy, sensor, np.zeros(3), self._free(), EVIDENCE, REACH_M, np.uint16(number + 1)
                )

    def _cover(self, tiles: TileMap, tile_bits: int, xy: Floats) -> None:
        low, high = xy.min(axis=0).tolist(), xy.max(axis=0).tolist()
        tiles.cover(tiles_of((low[0], low[1]), (high[0], high[1]), CELL_M, tile_bits, margin_cells=1))

    def _grid(self) -> SurfelGrid:
        (cells,) = self._surfels.pool.arrays
        return SurfelGrid(self._surfels.index(), cells, NO_FIELD, CELL_M)  # type: ignore[arg-type]

    def _free(self) -> OccupancyGrid:
        evidence, touched, changed = self._space.pool.arrays
        return OccupancyGrid(self._space.index(), evidence, touched, changed, CELL_M)  # type: ignore[arg-type]


NO_FIELD: npt.NDArray[np.float32] = np.zeros((POOL_TILES, 1, 1), np.float32)  # nothing reads it here


def _turned(normals: Floats, theta_rad: float) -> Floats:
    c, s = math.cos(theta_rad), math.sin(theta_rad)
    turned = normals.copy()
    turned[:, 0] = c * normals[:, 0] - s * normals[:, 1]
    turned[:, 1] = s * normals[:, 0] + c * normals[:, 1]
    return turned
