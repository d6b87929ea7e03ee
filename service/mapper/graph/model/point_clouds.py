"""Point clouds with wall normals, and surfels to align them with."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from service.geometry import poses as se2
from service.geometry.grid import tiles_of
from service.geometry.poses import Floats
from service.kernels import surfels
from service.kernels.filter_state import STUDENT
from service.kernels.loops import align_surfels
from service.kernels.match import MatchSettings
from service.kernels.surfels import MIN_NORMAL_COSINE, SurfelGrid, insert_surfels
from service.mapper.maps.tiles import Layer, TileMap, TilePool
from service.mapper.saved_graph import POINT_STEP_M, USUAL_RANGE_SIGMA_M

CELL_M = 0.10  # of the surfels of key frames
CLOUD_COUNT_LIMIT = 50.0  # limit of the points counted in a surfel of key frames
CLOUD_POOL_TILES = 4096
BLOCK_CELLS = 10.0  # edge of the blocks by which points are sorted: neighbouring normals share noise
NO_FIELD: npt.NDArray[np.float32] = np.zeros((CLOUD_POOL_TILES, 1, 1), np.float32)  # not read here
# Of Gauss-Newton on surfels; the scan match shares them.
ALIGNMENT = MatchSettings(
    range_sigma_m=USUAL_RANGE_SIGMA_M,
    surfel_sigma_m=USUAL_RANGE_SIGMA_M,
    wall_sigma_m=0.006,
    repeats=1.0,
    chance_chi2=0.0,
    information_chance_chi2=0.0,
    cauchy_m=0.10,
    least_normal_cosine=MIN_NORMAL_COSINE,
    iterations=15,
    inlier_m=0.10,  # largest distance of an inlier from its surfel
    settled_m=0.0005,  # a smaller step ends the alignment
    settled_rad=0.0001,
    degrees_of_freedom=STUDENT,
)


@dataclass(frozen=True, slots=True, eq=False)
class PointCloud:
    """Points of one or more scans in one frame."""

    xy: Floats  # (N, 2) m
    normals: Floats  # (N, 3) by estimate_normals
    sigma_m: Floats  # (N,) range noise, in multiples of POINT_STEP_M

    def transformed(self, pose: Floats) -> "PointCloud":
        """The cloud in the frame in which its own frame has the pose (3,)."""
        c, s = math.cos(pose[2]), math.sin(pose[2])
        normals = self.normals.copy()
        normals[:, 0] = c * self.normals[:, 0] - s * self.normals[:, 1]
        normals[:, 1] = s * self.normals[:, 0] + c * self.normals[:, 1]
        return PointCloud(se2.points_from(pose, self.xy), normals, self.sigma_m)

    def by_cell(self, pose: Floats) -> "PointCloud":
        """The points sorted by cell of the surfels, with the cloud at a pose (3,).

        Points in a cell, of whatever key frame, share the errors of its wall: [13] and [22] count them so.
        """
        row, column = np.floor(se2.points_from(pose, self.xy) / CELL_M).T
        block_row, block_column = np.floor(row / BLOCK_CELLS), np.floor(column / BLOCK_CELLS)
        order = np.lexsort((column, row, block_column, block_row))
        return PointCloud(self.xy[order], self.normals[order], self.sigma_m[order])


def cloud_with_noise(xy: Floats, normals: Floats, range_sigma_m: float = USUAL_RANGE_SIGMA_M) -> PointCloud:
    """A cloud with one range noise."""
    sigma_m = max(round(range_sigma_m / POINT_STEP_M), 1) * POINT_STEP_M
    return PointCloud(xy, normals, np.full(len(xy), sigma_m))


def joined(clouds: Sequence[PointCloud]) -> PointCloud:
    """Clouds of one frame, concatenated."""
    return PointCloud(
        np.concatenate([cloud.xy for cloud in clouds]),
        np.concatenate([cloud.normals for cloud in clouds]),
        np.concatenate([cloud.sigma_m for cloud in clouds]),
    )


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Alignment of a cloud with surfels."""

    pose: Floats  # (3,) of the cloud in the frame of the surfels
    information: Floats  # (3, 3) in the axes of the surfels
    share: float  # inlier ratio of the evaluated points


class SurfelSet:
    """Surfels of a cloud."""

    def __init__(self, cloud: PointCloud | None = None) -> None:
        cells = (surfels.TILE_CELLS,) * 2 + (2, 5)
        self._tiles = TileMap(TilePool((Layer(cells, np.float32),), CLOUD_POOL_TILES))
        if cloud is not None:
            self.insert(cloud)

    def insert(self, cloud: PointCloud) -> None:
        """Insert more points of the same frame."""
        if len(cloud.xy):
            cover(self._tiles, surfels.TILE_BITS, cloud.xy)
            for sigma_m in np.unique(cloud.sigma_m).tolist():
                of = cloud.sigma_m == sigma_m
                point_count = (USUAL_RANGE_SIGMA_M / sigma_m) ** 2
                insert_surfels(
                    cloud.xy[of],
                    cloud.normals[of],
                    np.zeros(3),
                    self.grid(),
                    CLOUD_COUNT_LIMIT,
                    point_count,
                    np.zeros(2),
                    -1,
                )

    def align(self, cloud: PointCloud, pose: Floats, chance_chi2: float = 0.0) -> Fit:
        """Another cloud aligned with the surfels, from a nearby pose. chance_chi2: see scan_information."""
        return self._fit(cloud, pose, ALIGNMENT._replace(chance_chi2=chance_chi2))

    def align_with_shared_errors(self, cloud: PointCloud, pose: Floats, chance_chi2: float) -> Fit:
        """As align, for a cloud of several key frames: points in one cell share the errors of its wall."""
        fit = self.align(cloud, pose, chance_chi2)
        as_it_lies = ALIGNMENT._replace(chance_chi2=chance_chi2, iterations=0)
        return replace(fit, information=self._fit(cloud.by_cell(fit.pose), fit.pose, as_it_lies).information)

    def _fit(self, cloud: PointCloud, pose: Floats, settings: MatchSettings) -> Fit:
        aligned, information = pose.copy(), np.zeros((3, 3))
        normals = cloud.normals.copy()
        normals[:, 2] *= (USUAL_RANGE_SIGMA_M / cloud.sigma_m) ** 2
        used, inliers = align_surfels(cloud.xy, normals, self.grid(), settings, aligned, information)
        return Fit(aligned, information, inliers / used if used else 0.0)

    def grid(self) -> SurfelGrid:
        (cells,) = self._tiles.pool.arrays
        return SurfelGrid(self._tiles.index(), cells, NO_FIELD, CELL_M)  # type: ignore[arg-type]


def cover(tiles: TileMap, tile_bits: int, xy: Floats) -> None:
    """Allocate tiles of CELL_M cells for some points."""
    low, high = xy.min(axis=0).tolist(), xy.max(axis=0).tolist()
    tiles.cover(tiles_of((low[0], low[1]), (high[0], high[1]), CELL_M, tile_bits, margin_cells=1))
