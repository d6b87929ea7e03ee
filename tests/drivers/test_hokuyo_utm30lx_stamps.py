"""Stamps of the whole driver against the moments the fake mirror really passed its first beam."""

from itertools import product

import numpy as np
import pytest

from drivers.hokuyo_utm30lx.driver import HokuyoUtm30lxSession
from simulators.hokuyo_setup import Utm30lxSetup
from simulators.hokuyo_utm30lx import FakeUtm30lx
from tests.drivers.utm30lx import NARROW, Room, config
from tests.drivers.virtual_time import LateTalk
from tests.soaked import every_other

MS = 1_000_000


def prompt(seed):
    rng = np.random.default_rng(seed)
    return lambda sent_ns: round((0.1 + rng.exponential(0.1)) * MS)


def stamp_errors(setup, delay_ns, seconds, **changes):
    """Error of each stamp in ms, seconds since the first scan, and the session."""
    room = Room()
    wire = {"host": "127.0.0.1"} if setup.wire == "ethernet" else {}
    session = HokuyoUtm30lxSession(config(**(NARROW | wire | changes)))
    talk = LateTalk(session, FakeUtm30lx(room, setup), delay_ns).run(seconds)
    truth_ns = np.array(room.first_rays_ns)
    stamps_ns = np.array([frame.stamp_ns for frame in talk.frames])
    nearest = truth_ns[np.abs(truth_ns - stamps_ns[:, np.newaxis]).argmin(axis=1)]
    assert np.diff(stamps_ns).min() > 0
    return (stamps_ns - nearest) / MS, (stamps_ns - stamps_ns[0]) / 1e9, session


@pytest.mark.parametrize(("wire", "seed"), every_other(product(["usb", "ethernet"], range(3))))
def test_asking_the_clock_takes_the_delay_off_where_the_wire_is_prompt(wire, seed):
    """The motor makes scans begin all over the device's millisecond, so its clock can be seen to a tenth."""
    setup = Utm30lxSetup(wire=wire, motor_speed=25.0 / 25.05, clock_drift_ppm=50.0)
    error_ms, age_s, _ = stamp_errors(setup, prompt(seed), 15.0)
    assert error_ms[age_s > 10.0].std() <= 0.05
    assert abs(error_ms[age_s > 10.0].mean()) <= 0.15


@pytest.mark.parametrize(
    "changes", [{}, {"cluster": 4, "skip_scans": 1, "first_angle_deg": 0.0, "last_angle_deg": 90.0}]
)
def test_the_first_beam_asked_for_is_stamped_not_step_0(changes):
    setup = Utm30lxSetup(motor_speed=25.0 / 25.05)
    error_ms, age_s, session = stamp_errors(setup, prompt(5), 14.0, **changes)
    middle_ms = (changes.get("cluster", 1) - 1) / 2 * 25.05 / 1440
    assert error_ms[age_s > 10.0].mean() == pytest.approx(middle_ms, abs=0.15)
    assert session.counters["scans_missed"] == 0


def test_a_device_that_stamps_the_rear_is_understood():
    setup = Utm30lxSetup(motor_speed=25.0 / 25.05, stamps_rear=True)
    error_ms, age_s, _ = stamp_errors(setup, prompt(2), 14.0, stamp_moment="rear")
    assert abs(error_ms[age_s > 10.0].mean()) <= 0.15
    error_ms, age_s, _ = stamp_errors(
        setup, prompt(2), 14.0
    )  # configured otherwise it is 45 deg of a turn early
    assert error_ms[age_s > 10.0].mean() == pytest.approx(-25.05 / 8, abs=0.15)
