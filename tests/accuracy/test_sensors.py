"""Odometry whose signs are wrong, where a corridor hardly constrains the position along."""

import math

import pytest

from service.mapper.profiles import build_mapper, mapping_config
from simulators.truth import Ride
from simulators.worlds import WORLDS
from tests.accuracy.driving import Trip, ok_and_wrong
from tests.accuracy.lasers import ALL, frames_of
from tests.accuracy.sensors import LMS100_10HZ, WRONG
from tests.simulated import Imu
from tests.soaked import in_soak

SEED = 12
SECONDS = 2.5


@pytest.mark.soak  # the first corner of it: tests/service/mapper/test_inconsistent_sensors.py
def test_odometry_backwards_is_not_followed_in_a_corridor() -> None:
    """At each scan it puts the vehicle 24 cm off, and all of the scan lies on the map there, too."""
    trip = Trip(WORLDS["ring"], LMS100_10HZ, imu=Imu(), change=WRONG["backwards"])
    ((_, done),) = trip.runs([SEED])
    assert ok_and_wrong(done) == 0
    assert math.hypot(*done.errors[-1, :2]) < 0.1


@pytest.mark.parametrize("seed", [11, in_soak(31)])
def test_a_laser_on_new_ground_is_neither_named_nor_shifted_along_the_corridor(seed: int) -> None:
    """The LUX ahead has the first scan; the UTM-30LX behind sees 1 % of what it saw, at rest for 0.7 s."""
    ride = Ride(WORLDS["ring"](), 0, 0.5)
    mapper = build_mapper(mapping_config(), {laser.name: laser.mounting for laser in ALL})
    start, mapped, by_chance = ride.pose(0), 0, 0
    for frame in frames_of(ride, ALL, SECONDS, seed):
        if (output := mapper.process(frame)) is None:
            continue
        by_chance += output.state != "ok"
        off = (start.inverse() @ ride.pose(output.stamp_ns)).inverse() @ output.pose_map_base
        assert abs(off.x_m) < 0.03
        assert abs(off.theta_rad) < 0.01
        mapped += frame.sensor == "rear" and output.state == "ok"
    assert mapped > 50
    assert by_chance <= 5
