"""Normals of narrow walls, which a scan hits with too few beams, from several key frames."""

import numpy as np
import numpy.typing as npt

from service.kernels.cell_moments import (
    HALVES,
    MOMENTS,
    MomentGrid,
    add_to_moments,
    direct_by_moments,
)
from service.kernels.normals import GRAZING_WEIGHT, ROUGH_WEIGHT
from service.kernels.surfels import TILE_BITS, TILE_CELLS
from service.mapper.components import Points
from service.mapper.maps.tiles import Layer, TileMap, TilePool, reach_of

Matrix = npt.NDArray[np.float64]

FOR_THE_MAP, FOR_THE_MATCH = range(HALVES)  # halves for surfels and for scans to be matched


def narrow_wall_pool(capacity: int) -> TilePool:
    """Pool for all sub-maps of a session, of so many tiles."""
    return TilePool((Layer((TILE_CELLS, TILE_CELLS, HALVES, MOMENTS), np.float32),), capacity)


class NarrowWalls:
    """Narrow walls of one sub-map; see service/kernels/cell_moments.py."""

    def __init__(self, pool: TilePool, cell_m: float) -> None:
        self._tiles = TileMap(pool)
        self._cell_m = cell_m
        self._next_half: dict[str, int] = {}  # by laser: each sees other walls

    def direct(
        self,
        points: Points,
        pose: Matrix,
        normals: Matrix,
        half: int = FOR_THE_MATCH,
        weight_off_plane: float = ROUGH_WEIGHT,
    ) -> None:
        """Set the normals (N, 3) that a scan at a pose (3,) has not itself; see direct_by_moments."""
        direct_by_moments(
            points.xy_base,
            points.sensor_xy_m,
            points.range_sigma_m,
            pose,
            self._grid(),
            half,
            GRAZING_WEIGHT,
            weight_off_plane,
            normals,
        )

    def insert(self, points: Points, normals: Matrix, pose: Matrix) -> Matrix:
        """Add a key frame at a pose (3,); returns its normals (N, 3) for insertion into the map."""
        directed = normals.copy()
        self.direct(points, pose, directed, FOR_THE_MAP, 0.0)
        half = self._next_half.get(points.scan.sensor, 0)
        self._next_half[points.scan.sensor] = (half + 1) % HALVES
        reach_m = reach_of(points.xy_base)
        self._tiles.cover_around((float(pose[0]), float(pose[1])), reach_m, self._cell_m, TILE_BITS)
        add_to_moments(
            points.xy_base,
            points.sensor_xy_m,
            points.range_sigma_m,
            normals,
            directed,
            pose,
            self._grid(),
            half,
        )
        return directed

    def release(self) -> None:
        """Release the tiles; they are cleared when taken again."""
        self._tiles.release()

    def _grid(self) -> MomentGrid:
        (moments,) = self._tiles.pool.arrays
        return MomentGrid(self._tiles.index(), moments, self._cell_m)  # type: ignore[arg-type]
