"""Occupied and free space, for maps that store only walls."""

import numpy as np
import numpy.typing as npt

from service.geometry.se2 import SE2
from service.kernels.occupancy import Evidence, count_overlap
from service.mapper.components import Overlap, Points
from service.mapper.maps.occupancy import Canvas

CELL_M = 0.10  # of the occupancy grid
FREE_RANGE_M = 20.0  # length up to which beams clear cells
# One hit makes a cell occupied, as in maps that store only walls. Misses of three scans clear a single hit,
# those of 16 any number of hits.
EVIDENCE = Evidence(hit=3, miss=-1, least=-1, most=15)
KNOWN_GROUND_POOL_TILES = 16_384  # 200 MB of address space: 0.67 km2


class KnownGround:
    """Occupancy in cells of 10 cm, odom frame. Filled with the same scans as the map."""

    def __init__(self) -> None:
        self._canvas = Canvas(EVIDENCE, FREE_RANGE_M, CELL_M, KNOWN_GROUND_POOL_TILES)

    def insert(self, points: Points, pose: SE2) -> None:
        sensor = points.sensor_base
        self._canvas.draw(points.xy_base, (sensor.x_m, sensor.y_m), pose)

    def overlap(self, xy_base: npt.NDArray[np.float64], pose: SE2) -> Overlap:
        """Points, (N, 2) m in the base frame, on walls and in free space."""
        at = np.array(pose)
        return Overlap(*count_overlap(xy_base, at, self._canvas.grid()))
