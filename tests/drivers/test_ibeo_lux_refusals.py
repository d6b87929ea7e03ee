"""A LUX that does not take a setting: its scans are used, cut to the configured angles, and named."""

import math

import numpy as np
import pytest

from drivers.errors import TransportError
from drivers.ibeo_lux.messages import Command, Parameter
from simulators.ibeo_lux import LuxSetup
from tests.drivers.lux import talk

READY = {0x1012: 0xFFEE, 0x1102: 6400}
RATE, START, END = Parameter.SCAN_FREQUENCY, Parameter.START_ANGLE, Parameter.END_ANGLE
NARROW = {"first_angle_deg": 30.0, "last_angle_deg": -20.0}


@pytest.mark.parametrize(
    ("setup", "reason"),
    [
        (LuxSetup(fixed=frozenset({RATE})), "refused 3 times, it has 12.5 Hz"),
        (LuxSetup(kept=frozenset({RATE})), "accepted, but it has 12.5 Hz"),
        (LuxSetup(unsupported=frozenset({RATE})), "refused 3 times"),
        (LuxSetup(refused=frozenset({Command.SET_PARAMETER})), "refused 3 times, it has 12.5 Hz"),
    ],
)
def test_scan_rate_that_it_does_not_take_is_used_as_it_is_and_named_in_hertz(setup, reason):
    t = talk(setup).run(5.0)
    assert len(t.frames) > 30
    assert t.frames[-1].scan_period_ns == pytest.approx(80e6, rel=0.01)
    assert t.session.status == (
        "streaming; scans at 12.5 Hz from 50 to -60 deg, configured 25 Hz from 50 to -60 deg; "
        f"configured scan_rate_hz 25 Hz not taken: {reason}; 31 C"
    )


@pytest.mark.parametrize("how", ["fixed", "kept"])
def test_angles_that_it_does_not_take_are_cut_by_the_driver(how):
    t = talk(LuxSetup(parameters=READY, **{how: frozenset({START, END})}), **NARROW).run(4.0)
    frame = t.frames[-1]
    assert len(t.frames) > 60
    assert frame.first_angle_rad == pytest.approx(math.radians(30.0))
    assert len(frame.range_m) == 50 * 8 + 1
    assert not np.isnan(frame.range_m[[0, -1]]).any()
    reason = {"fixed": "refused 3 times, it has", "kept": "accepted, but it has"}[how]
    assert t.session.status == (
        "streaming; scans at 25 Hz from 50 to -60 deg, configured 25 Hz from 30 to -20 deg, "
        f"cut to these angles by the driver; configured first_angle_deg 30 deg not taken: {reason} 50 deg; "
        f"configured last_angle_deg -20 deg not taken: {reason} -60 deg; 31 C"
    )


def test_beams_that_the_driver_cuts_off_do_not_move_the_stamp_of_the_others():
    cut, taken = (
        talk(LuxSetup(parameters=READY, fixed=fixed), **NARROW).run(4.0)
        for fixed in (frozenset({START, END}), frozenset())
    )
    for t in (cut, taken):
        truth_ns = np.array(t.room.first_rays_ns)
        tick_ns = 40e6 / 11_520
        ahead_ticks = 20 * 32 if t is cut else 0
        late_ns = t.frames[-1].stamp_ns - (truth_ns + ahead_ticks * tick_ns)
        assert np.abs(late_ns - 2_100_000).min() < 300_000  # it leaves 2 ms after its sweep, 0.1 on the wire


def test_scans_without_a_beam_in_the_configured_angles_are_no_scans():
    setup = LuxSetup(parameters=READY | {0x1101: 320}, fixed=frozenset({START, END}))  # 50 to 10 deg
    with pytest.raises(TransportError, match="without a beam in the configured field of view; write first_"):
        talk(setup, first_angle_deg=0.0).run(40.0)


@pytest.mark.parametrize(
    ("changes", "parameter", "words"),
    [
        (
            {"resolution": "focused"},
            Parameter.RESOLUTION,
            "resolution focused not taken: refused 3 times, it has constant",
        ),
        (
            {"sync_angle_deg": -90.0},
            Parameter.SYNC_ANGLE,
            "sync_angle_deg -90 deg not taken: refused 3 times, it has 0 deg",
        ),
    ],
)
def test_what_it_refuses_beside_rate_and_angles_is_done_without(changes, parameter, words):
    t = talk(LuxSetup(parameters=READY, fixed=frozenset({parameter})), **changes).run(4.0)
    assert len(t.frames) > 60
    assert f"; configured {words}" in t.session.status


def test_clock_that_it_does_not_let_set_is_named():
    refused = frozenset({Command.SET_NTP, Command.SET_NTP_SECONDS})
    t = talk(LuxSetup(parameters=READY, refused=refused)).run(3.0)
    assert t.frames
    assert "configured set_clock not taken" in t.session.status
