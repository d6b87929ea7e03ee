"""An LMS1xx that does not take a setting: its scans are used, cut to the field of view, and named."""

import math
import socket
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from drivers.errors import DeviceError, TransportError
from drivers.sick_lms100.driver import Lms100Session
from drivers.sick_lms100.protocol import Dialect, encode
from drivers.sick_lms100.telegrams import OutputRange, ScanConfig, ScanDataConfig, write_scan
from simulators.sick_lms100 import FakeLms100
from simulators.sick_setup import Lms100Setup
from tests.drivers.lms100 import Room, config, talk, telegram
from tests.drivers.over_tcp import frames_of_driver
from tests.drivers.test_sick_lms100_driver import part_of_the_view
from tests.drivers.virtual_time import Talk

HALF = {"first_angle_deg": -90.0, "last_angle_deg": 90.0}
RANGE = frozenset({"LMPoutputRange"})
WIDE = (
    "scans at 50 Hz and 0.5 deg from -135 to 135 deg, configured 50 Hz and 0.5 deg from -90 to 90 deg, "
    "cut to these angles by the driver"
)
DENIED = "refused 2 times: error A: write access denied: not logged in, or read-only"


@pytest.mark.parametrize(
    ("dialect", "setup", "reason"),
    [
        (
            Dialect.ASCII,
            Lms100Setup(refused=RANGE, firmware="V1.23"),
            f"configured field of view -90 to 90 deg not taken: LMPoutputRange {DENIED}",
        ),
        (
            Dialect.BINARY,
            Lms100Setup(kept=RANGE),
            "configured field of view -90 to 90 deg not taken: after LMPoutputRange was accepted it has "
            "-135 to 135 deg",
        ),
    ],
)
def test_field_of_view_that_it_does_not_take_is_cut_by_the_driver(dialect, setup, reason):
    t = talk(replace(setup, dialect=dialect), **HALF).run(1.5)
    assert len(t.frames) > 20
    assert {len(frame.range_m) for frame in t.frames} == {361}
    assert t.frames[0].first_angle_rad == pytest.approx(math.radians(-90.0))
    assert t.session.status == f"streaming; {WIDE}; {reason}"
    t.run(20.0)
    assert len(t.frames) > 1000


def test_beams_that_the_driver_cuts_off_do_not_move_the_stamp_of_the_others():
    cut, whole = (Lms100Session(config(**changes)) for changes in (HALF, {}))
    wire = encode(write_scan(telegram(values=range(1000, 1541)), Dialect.ASCII))
    [frame], [full] = (session.receive_data(wire, 2_000_000_000) for session in (cut, whole))
    assert frame.stamp_ns == full.stamp_ns + 90 * full.beam_interval_ns
    np.testing.assert_array_equal(frame.range_m, full.range_m[90:451])


def test_scans_without_a_beam_in_the_field_of_view_are_no_scans():
    session = Lms100Session(config(first_angle_deg=100.0))
    scans = (part_of_the_view(k, count=181) for k in range(1, 31))  # -135 to -45 deg
    for scan in scans:
        assert session.receive_data(encode(write_scan(scan, Dialect.BINARY)), scan.sent_us * 1000) == []
    assert session.counters["scans_outside_field_of_view"] == 30
    setup = Lms100Setup(refused=RANGE, output_range=OutputRange(-450_000, 450_000))
    with pytest.raises(TransportError, match="without a beam in the configured field of view; write first_"):
        talk(setup, first_angle_deg=100.0).run(60.0)


@pytest.mark.parametrize(
    ("setup", "reason"),
    [
        (
            {"refused": frozenset({"mLMPsetscancfg"})},
            "mLMPsetscancfg refused 2 times: error 1: method access denied: log in with a higher level",
        ),
        (
            {"kept": frozenset({"mLMPsetscancfg"})},
            "45 s after mLMPsetscancfg was accepted it has 25 Hz and 0.5 deg",
        ),
    ],
)
def test_scan_rate_that_it_does_not_take_is_used_as_it_is(setup, reason):
    t = talk(Lms100Setup(scan=ScanConfig(2500, 5000), **setup)).run(60.0)
    assert len(t.frames) > 200
    assert t.frames[-1].scan_period_ns == 40_000_000
    assert t.session.status == (
        "streaming; scans at 25 Hz and 0.5 deg from -135 to 135 deg, configured 50 Hz and 0.5 deg from -135 "
        f"to 135 deg; configured 50 Hz and 0.5 deg not taken: {reason}"
    )


def test_status_of_a_refused_scan_rate_has_the_devices_reason():
    """The fake device takes all pairs that the config allows; one that cannot is given them all the same."""
    t = talk(Lms100Setup(scan=ScanConfig(2500, 5000)))
    t.device._set_scan_config = lambda r, now_ns: lambda w: w.u8(2)
    t.run(10.0)
    assert t.session.status.endswith("not taken: mLMPsetscancfg refused: angle step not possible")
    assert len(t.frames) > 100


@pytest.mark.parametrize("how", ["refused", "kept"])
def test_echo_and_intensity_that_it_does_not_take_are_done_without(how):
    setup = Lms100Setup(**{how: frozenset({"LMDscandatacfg"})})
    t = talk(setup, echo="last", intensity_bits=8).run(3.0)
    assert len(t.frames) > 50
    assert len(t.frames[-1].intensity) == 0
    reason = {
        "refused": f"LMDscandatacfg {DENIED}",
        "kept": "after LMDscandatacfg was accepted it has first echo, intensity_bits 0, every scan",
    }[how]
    wanted = "both echoes, intensity_bits 8, every scan"
    assert t.session.status == f"streaming; configured {wanted} not taken: {reason}"


def test_device_that_goes_on_sending_every_second_scan_has_twice_the_period_and_misses_none():
    setup = Lms100Setup(
        scan_data=ScanDataConfig(1, False, False, interval=2), refused=frozenset({"LMDscandatacfg"})
    )
    t = talk(setup).run(4.0)
    assert t.frames[-1].scan_period_ns == 40_000_000
    assert t.frames[-1].stamp_ns - t.frames[-2].stamp_ns == pytest.approx(40_180_000, abs=100_000)
    assert t.session.counters["scans_missed"] == 0


def test_write_that_cannot_be_done_for_8_s_is_given_up_and_named():
    t = talk(Lms100Setup(first_writes_refused=100), intensity_bits=8).run(12.0)
    assert t.frames
    assert "LMDscandatacfg refused 5 times: error 4: local condition failed" in t.session.status


def test_device_that_measures_and_refuses_the_login_is_used_as_it_is():
    t = talk(password_hash="00000000", **HALF).run(2.0)
    assert {len(frame.range_m) for frame in t.frames} == {361}
    assert t.session.status.endswith(
        "not taken: login as authorised client refused (hash 00000000), has the password been changed? "
        "Set password_hash"
    )


def test_device_that_measures_and_refuses_to_be_started_is_not_waited_for():
    t = talk(Lms100Setup(refused=RANGE | {"LMCstartmeas"}), **HALF).run(2.0)
    assert len(t.frames) > 50
    assert t.session.counters["starts_refused"] == 1


def test_device_at_rest_that_cannot_be_logged_into_is_a_device_error():
    with pytest.raises(DeviceError, match=r"login .* refused .*password_hash"):
        Talk(
            Lms100Session(config(password_hash="00000000")), FakeLms100(Room(), Lms100Setup(measuring=False))
        ).connect().run(9.0)


def test_pretended_unit_of_2009_gives_scans_at_once(shared):
    script = shared / "cases/sick_v123_output_range.py"
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with subprocess.Popen([sys.executable, script, str(port)], stdout=subprocess.DEVNULL) as server:
        try:
            frames, health = frames_of_driver("sick_lms100", config(host="127.0.0.1", port=port, **HALF), 50)
        finally:
            server.kill()
    assert {len(frame.range_m) for frame in frames} == {361}
    assert health.status.startswith(f"streaming; {WIDE}; configured field of view -90 to 90 deg not taken:")
