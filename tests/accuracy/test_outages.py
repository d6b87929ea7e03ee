"""Which moments of an outage are on known ground, and that bounds hold on it alone."""

import math

import pytest

from drivers.frames import LaserScan
from simulators.worlds import WORLDS
from tests.accuracy.outages import Outcome, is_on_known_ground
from tests.accuracy.sensors import LMS100_10HZ
from tests.simulated import Drive, drive


@pytest.fixture(scope="module")
def made() -> Drive:
    """A third of a lap of the ring corridor, along new walls."""
    return drive(WORLDS["ring"](), LMS100_10HZ, 25.0, 1)


def test_where_the_vehicle_stays_the_ground_is_known_and_far_on_it_is_not(made: Drive) -> None:
    stamps = [frame.stamp_ns for frame in made.frames if isinstance(frame, LaserScan)]
    begun_ns, end_ns = stamps[len(stamps) // 10], stamps[-1]
    assert is_on_known_ground(made, end_ns, end_ns)
    assert is_on_known_ground(made, begun_ns, begun_ns + 100_000_000)
    assert not is_on_known_ground(made, begun_ns, end_ns)


def test_only_known_ground_has_to_be_found() -> None:
    outcome = Outcome(
        wrong_ok=[0.0, 0.0],
        wrong_degraded=[0.0, 0.0],
        found_s=[1.0, math.inf],
        ok_s=[1.0, math.inf],
        end_mm=[20.0, 3000.0],
        on_known_ground=[True, False],
        ghosts=[0.0, 0.0],
    )
    met = {row.what: row.met for row in outcome.rows("office", has_to_be_found=True)}
    assert met["known ground (1 moments): found again after"] is True
    assert met["known ground (1 moments): off at the end"] is True
    assert met["new ground (1 moments): found again after"] is None
    outcome.on_known_ground = [False, True]
    met = {row.what: row.met for row in outcome.rows("office", has_to_be_found=True)}
    assert met["known ground (1 moments): found again after"] is False
    assert met["known ground (1 moments): off at the end"] is False
    anywhere = outcome.rows("office", has_to_be_found=False)
    assert {row.met for row in anywhere if "ground (" in row.what} == {None}
