"""Mirrors of 2 and 5 Hz, as cheap lasers have: the vehicle turns and brakes within a sweep."""

from dataclasses import replace

import pytest

from service.mapper.profiles import mapping_config
from simulators.worlds import WORLDS
from tests.accuracy.driving import Trip, ate_m
from tests.simulated import LMS100_50HZ, Wheels, run
from tests.soaked import in_soak


# By the twist alone 1.53 and 0.10 m.
@pytest.mark.parametrize(("rate_hz", "seed"), [(2.0, 23), in_soak(5.0, 21)])
def test_the_corners_of_a_ring_are_mapped(rate_hz: float, seed: int):
    trip = Trip(WORLDS["ring"], replace(LMS100_50HZ, rate_hz=rate_hz), None, Wheels())
    (made,) = trip.drives([seed])
    done = run(mapping_config(), made)
    assert ate_m(made, done, [output.pose_map_base for output in done.outputs]) < 0.04
    assert all(output.state != "lost" for output in done.outputs)
