"""People who walk beside the vehicle, and a laser that has nothing else to go by."""

from pathlib import Path

import numpy as np
import pytest

from service.kernels import small_objects
from service.kernels.normals import ROUGH_WEIGHT
from service.mapper.profiles import mapping_config
from simulators.worlds import WORLDS
from tests.accuracy.sensors import LUX_AHEAD
from tests.recorded_drive import mapped
from tests.simulated import begun_at, drive, heading_rad, run


def test_a_laser_alone_does_not_follow_people_who_walk_with_the_vehicle_from_the_start() -> None:
    """Two of them, ahead, give a quarter of the returns; it was 2 m off after 4 s, with a sigma of 2 cm."""
    made = drive(begun_at(WORLDS["crowd"](), heading_rad(31)), LUX_AHEAD, 6.0, 31)
    done = run(mapping_config(), made)
    assert np.hypot(*done.errors[:, :2].T).max() < 0.05
    assert {output.state for output in done.outputs} == {"ok"}


def test_walls_that_fit_at_two_poses_do_not_bend_the_map_towards_the_prediction(shared: Path) -> None:
    """Odometry turns late among desks that stand still. By the walls, which are square, it turned 64 deg."""
    outputs = mapped(shared / "datasets" / "mines1")
    stamp_s = [output.stamp_ns * 1e-9 for output in outputs]
    heading_rad = np.unwrap([output.pose_odom_base.theta_rad for output in outputs])
    begin_deg, end_deg = np.degrees(np.interp([224.0, 228.0], stamp_s, heading_rad))
    assert 58.0 < end_deg - begin_deg < 68.0  # 55.5 with the optimum near the prediction alone


def run_of(centre: tuple[float, float], width_m: float, count: int = 12) -> np.ndarray:
    """(count, 2) returns abreast, seen from the origin."""
    return np.column_stack((np.full(count, centre[0]), centre[1] + np.linspace(-0.5, 0.5, count) * width_m))


@pytest.mark.parametrize(
    ("runs", "small"),
    [
        pytest.param([((2.0, 0.0), 0.4)], [True], id="a person"),
        pytest.param([((2.0, 0.0), 1.0)], [False], id="wider than a person"),
        pytest.param(
            [((4.0, -2.0), 1.8), ((2.0, 0.0), 0.4), ((4.0, 2.0), 1.8)],
            [False, True, False],
            id="before a wall",
        ),
        pytest.param([((20.0, 0.0), 8.0)], [False], id="a wall far away, with gaps of 0.7 m"),
    ],
)
def test_a_run_of_returns_as_narrow_as_a_person_is_small(
    runs: list[tuple[tuple[float, float], float]], small: list[bool]
) -> None:
    xy_base = np.vstack([run_of(*one) for one in runs])
    normals = np.column_stack(
        (np.ones(len(xy_base)), np.zeros(len(xy_base)), np.full(len(xy_base), ROUGH_WEIGHT))
    )
    normals[0, 2] = 0.0  # no normal: of no object
    is_small = np.zeros(len(xy_base), np.bool_)
    marked = small_objects.mark_small_runs.py_func(xy_base, normals, is_small)
    expected = np.repeat(small, 12)
    expected[0] = False
    np.testing.assert_array_equal(is_small, expected)
    assert marked == expected.sum()
