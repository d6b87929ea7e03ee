import math

import numpy as np
import pytest

from service.kernels.beam_verdicts import BESIDE, CLOSE, IN_FREE, NEW, ON_WALL, THROUGH, judge_beams
from service.kernels.occupancy import Evidence, OccupancyGrid, trace_scan
from service.kernels.surfels import SurfelGrid, insert_surfels
from tests.service.kernels.occupancy_grids import empty_occupancy
from tests.service.kernels.surfel_grids import empty_grid

EVIDENCE = Evidence(hit=24, miss=-10, least=-70, most=70)
CELL_M, FREE = 0.1, -10
WALL_X_M = 3.05  # in the middle of a cell
SENSOR = (0.0, 0.0)


def mapped() -> tuple[SurfelGrid, OccupancyGrid]:
    """A wall across x = 3.05 m from y = -1.5 to 1.5 m, seen from the origin."""
    y = np.arange(-1.5, 1.5, 0.02)
    xy = np.column_stack((np.full(len(y), WALL_X_M), y))
    walls, free = empty_grid(), empty_occupancy(CELL_M)
    insert_surfels(xy, np.tile([-1.0, 0.0, 1.0], (len(y), 1)), np.zeros(3), walls, 50.0)
    trace_scan(xy, np.zeros(2), np.zeros(3), free, EVIDENCE, 20.0, np.uint16(1))
    return walls, free


def verdict_of(end: tuple[float, float], walls: SurfelGrid, free: OccupancyGrid, pose=(0.0, 0.0, 0.0)) -> int:
    """Of one beam from SENSOR, both as the map has them; asked from a base with a pose in it."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    turn = np.array([[c, -s], [s, c]])
    here = (np.array([end, SENSOR]) - pose[:2]) @ turn
    normal = np.array([-1.0, 0.0]) @ turn
    verdict = np.empty(1, np.int64)
    judge_beams(here[:1], np.array([[*normal, 1.0]]), here[1:], np.array(pose), walls, free, FREE, verdict)
    return int(verdict[0])


@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), (0.7, -0.4, 2.2)])
@pytest.mark.parametrize(
    ("end", "expected"),
    [
        ((WALL_X_M + 0.01, 0.0), CLOSE),
        ((WALL_X_M - 0.06, 0.3), ON_WALL),
        ((1.55, 0.05), IN_FREE),
        ((4.0, 0.0), THROUGH),
        ((-2.0, 0.0), NEW),
        ((WALL_X_M - 0.12, 0.0), BESIDE),
    ],
)
def test_a_beam_is_judged_by_where_it_ends(end, expected, pose):
    assert verdict_of(end, *mapped(), pose) == expected


def test_a_beam_past_the_end_of_a_wall_does_not_look_through_it():
    assert verdict_of((4.0, 3.0), *mapped()) == NEW


def test_a_wall_that_the_map_itself_looked_through_later_is_none():
    walls, free = mapped()
    assert verdict_of((4.0, 0.0), walls, free) == THROUGH
    beyond = np.column_stack((np.full(81, 4.5), np.linspace(-0.4, 0.4, 81)))
    for number in range(2, 7):
        trace_scan(beyond, np.zeros(2), np.zeros(3), free, EVIDENCE, 20.0, np.uint16(number))
    assert verdict_of((4.0, 0.0), walls, free) == IN_FREE
