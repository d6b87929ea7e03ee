"""Scans into frames: values, faults, stamps; and the whole driver over loopback."""

import math
from itertools import product

import numpy as np
import pytest

from drivers.errors import DeviceError, ProtocolError, TransportError
from drivers.ibeo_lux.driver import IbeoLuxSession
from drivers.ibeo_lux.messages import ErrorRegisters, Parameter
from drivers.ibeo_lux.protocol import DataType, Message, encode
from simulators.ibeo_lux import LuxSetup
from tests.drivers.lux import config, ntp, points, reconnect, scan, talk, wire
from tests.drivers.virtual_time import SECOND_NS
from tests.soaked import every_other

SWEEP_NS = 12_222_222  # 110 deg at 25 Hz
PERIOD_NS = 40_000_000


def ready_session(**changes):
    """A session that takes scans: one whose device sends but does not answer."""
    return made_ready(IbeoLuxSession(config(**changes), lambda: 0))


def made_ready(session):
    session._dialogue.ready = session._runner.ended = True
    return session


def frames_of(*scans, session=None, arrived_after_ns=1_000_000, **changes):
    session = session or ready_session(**changes)
    frames = []
    for made in scans:
        arrived_ns = (made.end_ntp * SECOND_NS >> 32) + 50 * SECOND_NS + arrived_after_ns
        frames += session.receive_data(wire(made), arrived_ns)
    return frames, session


def test_frame_carries_what_the_scan_says():
    [frame], session = frames_of(scan((1, 0, 0, 1600, 1000, 60), (2, 0, 0, -1920, 2000, 80)), intensity=True)
    assert (frame.sensor, frame.scan_period_ns) == ("lux", pytest.approx(PERIOD_NS, abs=5))
    assert frame.stamp_ns == pytest.approx(60 * SECOND_NS + 1_000_000, abs=2)
    assert frame.beam_interval_ns == round(PERIOD_NS * 4 / 11_520)
    assert frame.first_angle_rad == pytest.approx(math.radians(50.0))
    assert frame.angle_step_rad == pytest.approx(math.radians(-0.125))
    assert (frame.range_min_m, frame.range_max_m, len(frame.range_m)) == (0.3, 200.0, 881)
    assert np.flatnonzero(~np.isnan(frame.range_m)).tolist() == [0, 880]
    assert frame.range_m[[0, -1]].tolist() == pytest.approx([10.0, 20.0], rel=1e-4)
    assert frame.intensity[[0, 1, 880]].tolist() == [60.0, 0.0, 80.0]
    assert frame.stamp_ns + 880 * frame.beam_interval_ns == pytest.approx(frame.arrived_ns, abs=1_000)
    assert session.clock_offset_ns == pytest.approx(50 * SECOND_NS + 1_000_000, abs=2)


def test_first_beam_of_a_coarse_grid_lies_before_the_first_shot_and_so_does_its_stamp():
    [frame], _ = frames_of(scan((1, 0, 0, 1594, 1000, 60), first=1594), angle_step_deg=0.25)
    assert math.degrees(frame.first_angle_rad) == pytest.approx(50.0)
    assert frame.stamp_ns == pytest.approx(60 * SECOND_NS + 1_000_000 - 6 * PERIOD_NS / 11_520, abs=100)


def test_scans_before_the_device_is_set_up_are_left_out():
    session = IbeoLuxSession(config(), lambda: 0)
    session.tick(10**12)
    assert session.receive_data(wire(scan((1, 0, 0, 0, 1000, 60))), 10**12) == []
    assert session.counters["scans_before_ready"] == 1
    assert session.status == "waiting for the first answer: booting?"
    assert session.clock_offset_ns is None


def test_truncated_scans_are_counted_in_the_status_while_they_come():
    made = [
        scan((1, 0, 0, 1600, 1000, 60), number=k, start_ns=10 * SECOND_NS + PERIOD_NS * k, announced_points=n)
        for k, n in ((1, 740), (2, 740), (3, 1))
    ]
    _, session = frames_of(*made)
    assert session.status == "streaming; scans with fewer points than announced, 2 so far"
    later_ns = 10 * SECOND_NS + PERIOD_NS * 4 + 16 * SECOND_NS
    whole = scan((1, 0, 0, 1600, 1000, 60), number=404, start_ns=later_ns)
    assert frames_of(whole, session=session)[1].status == "streaming"


def test_missing_repeated_and_restarted_scans_are_counted():
    numbers, periods = (65_534, 65_535, 65_535, 0, 3, 20_000), (0, 1, 1, 2, 5, 6)
    made = [
        scan(number=number, start_ns=10 * SECOND_NS + PERIOD_NS * k)
        for number, k in zip(numbers, periods, strict=True)
    ]
    frames, session = frames_of(*made)
    assert len(frames) == 5
    assert session.counters["scans_repeated"] == 1
    assert session.counters["scans_missed"] == 2
    assert session.counters["scan_number_restarts"] == 1
    assert session.counters["scans_received"] == 6


def test_scans_of_one_number_and_time_are_taken_where_their_points_differ():
    """Some converters write one header again and again; then only the arrival tells the time."""
    session, frames = ready_session(latency_ms=3.0), []
    for k in range(100):
        made = scan((1, 0, 0, 1600, 1000 + k, 60), (2, 0, 0, -1920, 2000, 80))
        frames += session.receive_data(wire(made), 60 * SECOND_NS + PERIOD_NS * k)
    assert len(frames) == 100
    assert frames[50].range_m[0] == pytest.approx(10.5, rel=1e-3)
    assert np.diff([frame.stamp_ns for frame in frames[1:]]).tolist() == [PERIOD_NS] * 98
    last = frames[-1]
    assert last.stamp_ns == pytest.approx(last.arrived_ns - SWEEP_NS - 3_000_000, abs=2)
    assert session.counters["scans_stamped_by_arrival"] == 99
    assert session.counters["scans_repeated"] == session.counters["scan_number_restarts"] == 0
    assert "its clock stands still, stamps are those of arrival" in session.status


def test_device_whose_number_and_clock_stand_still_is_reported():
    _, session = frames_of(*[scan()] * 30)
    assert session.counters["scans_repeated"] == 29
    assert "the same scan again and again, not used" in session.status
    for tick in range(11):
        session.tick(100 * SECOND_NS + tick * 200_000_000)
    with pytest.raises(TransportError, match="no new scan for 2 s: it repeats the same one"):
        session.tick(102_200_000_000)


@pytest.mark.parametrize(
    ("spoilt", "words"),
    [
        ({"end_ntp": ntp(10 * SECOND_NS)}, "begin and end stamps do not fit"),
        ({"end_ntp": ntp(9 * SECOND_NS)}, "begin and end stamps do not fit"),
        ({"end_ntp": ntp(11 * SECOND_NS)}, "begin and end stamps do not fit"),
        ({"end_ticks": 1600}, "expected a sweep from left to right"),
        ({"start_ticks": 32_000, "end_ticks": -32_000}, "expected a sweep from left to right"),
        ({"ticks_per_turn": 0}, "expected 11520"),
        (
            {"points": points((15, 15, 0, 0, 500, 100), (0, 3, 0, 0, 500, 100))},
            "of 2 points, none with a layer",
        ),
        ({"points": points((0, 0, 0, 1601, 500, 100))}, "of 1 point, none .* an angle that can be"),
    ],
)
def test_scan_without_sense_is_dropped_and_twenty_one_are_a_protocol_error(spoilt, words):
    bad = scan(**spoilt)
    frames, session = frames_of(*[bad] * 20)
    assert frames == []
    assert session.counters["scans_malformed"] == 20
    with pytest.raises(ProtocolError, match=words):
        session.receive_data(wire(bad), 10**12)


def test_unusable_replies_and_errors_are_counted():
    session = ready_session()
    session.receive_data(encode(Message(DataType.REPLY, b"\1")), 1)
    session.receive_data(encode(Message(DataType.REPLY, b"\x20\0")), 1)
    session.receive_data(encode(Message(DataType.ERRORS, b"\1")), 1)
    session.receive_data(b"garbage" + encode(Message(DataType.ERRORS, bytes(16))), 1)
    assert session.counters == {
        "replies_unusable": 1,
        "replies_not_asked_for": 1,
        "error_messages_unusable": 1,
        "bytes_skipped": 7,
    }


def test_errors_and_warnings_stand_in_the_status_and_fade():
    t = talk().run(2.0)
    t.device.report(ErrorRegisters(errors_2=0x0001, warnings_1=0x0010), t.now_ns)
    t.run(1.0)
    assert t.session.status == "streaming; error: no scan data; warning: high temperature; 31 C"
    assert t.session.counters["error: no scan data"] == 1
    t.run(20.0, until=lambda: t.session.status == "streaming; 31 C")
    assert t.session.status == "streaming; 31 C"


def test_motor_that_fails_is_a_device_error_in_words():
    t = talk().run(3.0)
    t.device.motor_failed = True
    with pytest.raises(DeviceError, match="no scan for 2 s, the device reports: motor 1 fault"):
        t.run(3.0)


def test_scans_of_another_device_are_named():
    message = encode(Message(DataType.SCAN_FUSION, bytes(500)))
    session = IbeoLuxSession(config(), lambda: 0)
    session.receive_data(message, 1)
    for k in range(1000):
        session.tick(k * 20_000_000)
    with pytest.raises(TransportError, match="no answer to Get status, but scans of an Ibeo fusion ECU"):
        session.tick(21 * SECOND_NS)
    session = ready_session()
    session.receive_data(message, 1)
    for k in range(1001):
        session.tick(k * 20_000_000)
    with pytest.raises(TransportError, match="no scan of a LUX for 20 s, but those of an Ibeo fusion ECU"):
        session.tick(1001 * 20_000_000)


def test_one_mirror_side_of_an_eight_layer_unit_has_half_the_rate():
    t = talk(mirror_sides="rear").run(3.0)
    assert {round(frame.scan_period_ns / 1e6) for frame in t.frames} == {80}
    assert set(np.rint(np.diff([frame.stamp_ns for frame in t.frames]) / 1e6)) == {80}
    assert t.session.counters["scans_of_other_mirror_side"] == pytest.approx(len(t.frames), abs=1)


@pytest.mark.parametrize(
    ("resolution", "rate_hz"), every_other(product(["constant", "focused"], [12.5, 25.0, 50.0]))
)
def test_frames_come_at_the_rate_asked_for_and_see_the_room_all_around(resolution, rate_hz):
    t = talk(scan_rate_hz=rate_hz, resolution=resolution).run(4.0)
    stamps_ns = np.array([frame.stamp_ns for frame in t.frames])
    assert np.diff(stamps_ns) == pytest.approx(1e9 / rate_hz, abs=1e4)
    frame = t.frames[-1]
    seen = ~np.isnan(frame.range_m)
    assert seen.sum() == (391 if resolution == "constant" else 396)
    np.testing.assert_allclose(frame.range_m[seen], 20.0, atol=0.011)
    assert t.session.counters["scans_missed"] == 0


def test_device_that_restarts_unseen_and_forgets_is_set_up_again():
    t = talk().run(5.0)
    t.device.power_on(t.now_ns)
    with pytest.raises(
        TransportError, match=r"11 scans in a row at 12[.]5 Hz from 50 to -60 deg, set was 25 Hz"
    ):
        t.run(3.0)
    reconnect(t).run(2.0)
    assert t.session.counters["scans_not_as_configured"] == 0


def test_beams_that_the_driver_cuts_off_do_not_move_the_stamp_of_the_others():
    cut, taken = (
        talk(
            LuxSetup(parameters={0x1012: 0xFFEE, 0x1102: 6400}, fixed=fixed),
            first_angle_deg=30.0,
            last_angle_deg=-20.0,
        ).run(4.0)
        for fixed in (frozenset({Parameter.START_ANGLE, Parameter.END_ANGLE}), frozenset())
    )
    for t in (cut, taken):
        truth_ns = np.array(t.room.first_rays_ns)
        tick_ns = 40e6 / 11_520
        ahead_ticks = 20 * 32 if t is cut else 0
        late_ns = t.frames[-1].stamp_ns - (truth_ns + ahead_ticks * tick_ns)
        assert np.abs(late_ns - 2_100_000).min() < 300_000  # it leaves 2 ms after its sweep, 0.1 on the wire
