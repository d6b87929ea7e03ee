"""Odometry whose signs are wrong, where a corridor says little of the way along it."""

import math

import pytest

from simulators.worlds import WORLDS
from tests.accuracy.driving import Trip, ok_and_wrong
from tests.accuracy.sensors import LMS100_10HZ, WRONG
from tests.simulated import Imu

SEED = 12


@pytest.mark.soak  # the first corner of it: tests/service/mapper/test_inconsistent_sensors.py
def test_odometry_backwards_is_not_followed_in_a_corridor() -> None:
    """At each scan it puts the vehicle 24 cm off, and all of the scan lies on the map there, too."""
    trip = Trip(WORLDS["ring"], LMS100_10HZ, imu=Imu(), change=WRONG["backwards"])
    ((_, done),) = trip.runs([SEED])
    assert ok_and_wrong(done) == 0
    assert math.hypot(*done.errors[-1, :2]) < 0.1
