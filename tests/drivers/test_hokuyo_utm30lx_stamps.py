"""Stamps of the whole driver against the moments the pretended mirror really passed its first beam."""

from itertools import product

import numpy as np
import pytest

from drivers.hokuyo_utm30lx.driver import HokuyoUtm30lxSession
from simulators.hokuyo_setup import Utm30lxSetup
from simulators.hokuyo_utm30lx import FakeUtm30lx
from tests.drivers.utm30lx import LateTalk, Room, config
from tests.soaked import every_other, in_soak

MS = 1_000_000
NEAR_THE_WRAP_MS = 2**24 - 8_000
NARROW = {"first_angle_deg": -20.0, "last_angle_deg": 20.0}  # what it sees is no matter, and quicker made


def jittery(seed):
    """0.1 ms at the least, uniformly up to 3 ms more, and one in twenty up to 50 ms."""
    rng = np.random.default_rng(seed)

    def delay_ns(sent_ns):
        burst_ms = rng.uniform(0.0, 50.0) if rng.random() < 0.05 else 0.0
        return round((0.1 + rng.uniform(0.0, 3.0) + burst_ms) * MS)

    return delay_ns


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


TURNS = list(product([100.0, -100.0], [1.0, 1.0001, 25.0 / 25.05, 1.004, 24.9999 / 25.0]))


@pytest.mark.parametrize(
    ("drift_ppm", "motor_speed"),
    [case if k in (1, 5, 9) else in_soak(*case) for k, case in enumerate(TURNS)],
)
def test_stamps_scatter_less_than_a_fifth_of_a_millisecond_under_jitter_bursts_drift_and_a_wrap(
    drift_ppm, motor_speed
):
    setup = Utm30lxSetup(motor_speed=motor_speed, clock_drift_ppm=drift_ppm, clock_start_ms=NEAR_THE_WRAP_MS)
    error_ms, age_s, session = stamp_errors(setup, jittery(1), 19.0)
    old = age_s > 10.0
    assert error_ms[old].std() <= 0.2
    assert abs(error_ms[old].mean()) <= 1.0  # half of it is the device's millisecond
    assert session.counters["scans_missed"] == session.counters["scans_out_of_order"] == 0
    assert session.counters["clock_resets"] == 0


@pytest.mark.parametrize(("wire", "seed"), every_other(product(["usb", "ethernet"], range(3))))
def test_asking_the_clock_takes_the_delay_off_where_the_wire_is_prompt(wire, seed):
    """The motor makes scans begin all over the device's millisecond, so its clock can be seen to a tenth."""
    setup = Utm30lxSetup(wire=wire, motor_speed=25.0 / 25.05, clock_drift_ppm=50.0)
    error_ms, age_s, _ = stamp_errors(setup, prompt(seed), 15.0)
    assert error_ms[age_s > 10.0].std() <= 0.05
    assert abs(error_ms[age_s > 10.0].mean()) <= 0.15


@pytest.mark.parametrize(
    "changes",
    [
        {"cluster": 3},
        {"skip_scans": 2},
        {"first_angle_deg": -90.0, "last_angle_deg": 45.0},
        {"cluster": 4, "skip_scans": 1, "first_angle_deg": 0.0, "last_angle_deg": 90.0},
    ],
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


def test_latency_from_calibration_makes_stamps_earlier():
    setup = Utm30lxSetup(motor_speed=25.0 / 25.05)
    plain, _, _ = stamp_errors(setup, prompt(3), 4.0)
    early, _, _ = stamp_errors(setup, prompt(3), 4.0, latency_ms=2.5)
    np.testing.assert_allclose(plain - early, 2.5, atol=1e-6)


@pytest.mark.parametrize("seed", [0, in_soak(1), in_soak(2)])
def test_a_restart_of_the_clock_is_recovered_within_three_seconds(seed):
    room = Room()
    setup = Utm30lxSetup(motor_speed=25.0 / 25.05, clock_drift_ppm=100.0, clock_start_ms=1_000_000)
    device = FakeUtm30lx(room, setup)
    session = HokuyoUtm30lxSession(config(**NARROW))
    talk = LateTalk(session, device, jittery(seed)).run(20.0)
    before, restart_ns = len(talk.frames), talk.now_ns
    device.restart_clock(talk.now_ns)
    talk.run(20.0)
    assert session.counters["clock_resets"] == 1
    truth_ns = np.array(room.first_rays_ns)
    stamps_ns = np.array([frame.stamp_ns for frame in talk.frames])
    error_ms = (stamps_ns - truth_ns[np.abs(truth_ns - stamps_ns[:, np.newaxis]).argmin(axis=1)]) / MS
    old = error_ms[300:before]
    recovered = stamps_ns > restart_ns + 3_000 * MS
    assert np.abs(error_ms[recovered] - old.mean()).max() <= 1.0
    assert error_ms[stamps_ns > restart_ns + 10_000 * MS].std() <= 0.2
