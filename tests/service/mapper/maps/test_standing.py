import math

import numpy as np
import pytest

from service.geometry.se2 import SE2
from service.mapper.components import Standing
from service.mapper.maps.occupancy import SHOWN_REACH_M, draw_standing
from service.mapper.pipeline import Mapper
from service.mapper.profiles import build_mapper, mapping_config
from service.outputs import NO_REASON, UNKNOWN, Grid, MapperOutput
from simulators.truth import LMS100, Ride
from simulators.worlds import build_world
from tests.simulated import Laser, scans


def newest(pose_odom_base: SE2, pose_map_odom: SE2 = SE2()) -> MapperOutput:  # noqa: B008 - never changed
    return MapperOutput(
        0, pose_odom_base, pose_map_odom, (0.0, 0.0, 0.0), np.zeros((3, 3)), "ok", NO_REASON, 1.0
    )


def at(grid: Grid, x_m: float, y_m: float) -> int:
    column = math.floor((x_m - grid.x_min_m) / grid.cell_m)
    return int(grid.cells[math.floor((y_m - grid.y_min_m) / grid.cell_m), column])


def test_a_cell_has_the_share_of_what_stands_in_it_longest_and_others_are_unknown() -> None:
    xy_odom = np.array([(0.05, 0.05), (0.06, 0.05), (3.05, -1.05)])
    grid = draw_standing(Standing(xy_odom, np.array([0.2, 0.85, 1.0]), 0.1), newest(SE2()))
    assert grid is not None
    assert (grid.cells.shape, grid.cell_m) == ((12, 31), 0.1)
    assert (at(grid, 0.05, 0.05), at(grid, 3.05, -1.05)) == (85, 100)
    assert np.count_nonzero(grid.cells != UNKNOWN) == 2


def test_it_lies_in_the_map_where_the_loops_put_it() -> None:
    moved = SE2(5.0, -2.0, math.pi / 2.0)
    grid = draw_standing(Standing(np.array([(1.05, 0.05)]), np.ones(1), 0.1), newest(SE2(), moved))
    assert grid is not None
    assert grid.cells.tolist() == [[100]]
    assert (grid.x_min_m, grid.y_min_m) == pytest.approx((4.9, -1.0))


def test_what_is_far_from_the_vehicle_is_left_out() -> None:
    xy_odom = np.array([(100.0, 0.05), (100.0 + SHOWN_REACH_M + 1.0, 0.05), (0.0, 0.0)])
    grid = draw_standing(Standing(xy_odom, np.ones(3), 0.1), newest(SE2(99.0, 0.0, 0.0)))
    assert grid is not None
    assert grid.cells.shape == (1, 1)
    assert draw_standing(Standing(xy_odom, np.ones(3), 0.1), newest(SE2(300.0, 0.0, 0.0))) is None


@pytest.mark.parametrize(("profile", "is_known"), [("corridor", True), ("imle", False)])
def test_a_mapper_tells_it_where_its_profile_knows(profile: str, is_known: bool) -> None:
    laser = Laser(LMS100, 541, 25.0, -135.0, 0.5)
    mapper: Mapper[object] = build_mapper(mapping_config({"profile": profile}), {laser.name: SE2()})
    assert mapper.standing() is None  # nothing is mapped yet
    for scan in scans(Ride(build_world("office"), 0, 0.5), laser, 0.5, [1])[0]:
        mapper.process(scan)
    grid = mapper.standing()
    assert (grid is not None) == is_known
    assert grid is None or grid.cells.max() > 20
