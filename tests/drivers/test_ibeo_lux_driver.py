"""Scans into frames: values, faults, stamps; and the whole driver over loopback."""

import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivers.errors import DeviceError, ProtocolError, TransportError
from drivers.ibeo_lux.driver import IbeoLuxSession
from drivers.ibeo_lux.messages import ErrorRegisters, ScanFlag, read_scan
from drivers.ibeo_lux.protocol import DataType, Message, encode
from simulators.ibeo_lux import LEAVES_AFTER_SWEEP_NS, FakeIbeoLux, LuxSetup
from tests.drivers.lux import Room, config, ntp, points, reconnect, scan, talk, wire
from tests.drivers.over_tcp import frames_over_tcp
from tests.drivers.virtual_time import SECOND_NS
from tests.soaked import in_soak

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


def test_latency_makes_stamps_earlier():
    [frame], _ = frames_of(scan(), latency_ms=1.0)
    assert frame.stamp_ns == pytest.approx(60 * SECOND_NS, abs=2)
    assert frame.intensity.shape == (0,)


def test_scans_before_the_device_is_set_up_are_left_out():
    session = IbeoLuxSession(config(), lambda: 0)
    session.tick(10**12)
    assert session.receive_data(wire(scan((1, 0, 0, 0, 1000, 60))), 10**12) == []
    assert session.counters["scans_before_ready"] == 1
    assert session.status == "waiting for the first answer: booting?"
    assert session.clock_offset_ns is None


def test_truncated_scan_is_a_frame_of_what_came():
    made = scan((1, 0, 0, 1600, 1000, 60), announced_points=740)
    [frame], session = frames_of(made)
    assert session.counters["scans_truncated"] == 1
    assert np.count_nonzero(~np.isnan(frame.range_m)) == 1


def test_truncated_scans_are_counted_in_the_status_while_they_come():
    made = [
        scan((1, 0, 0, 1600, 1000, 60), number=k, start_ns=10 * SECOND_NS + PERIOD_NS * k, announced_points=n)
        for k, n in ((1, 740), (2, 740), (3, 1))
    ]
    frames, session = frames_of(*made)
    assert session.status == "streaming; scans with fewer points than announced, 2 so far"
    session.tick(frames[1].arrived_ns + 15 * SECOND_NS)
    assert session.status == "streaming; scans with fewer points than announced, 2 so far"
    session._silence.heard()
    session.tick(frames[1].arrived_ns + 15 * SECOND_NS + 1)
    assert session.status == "streaming"


def test_real_scan_becomes_a_frame(shared):
    payload = (shared / "captures/ibeo/ldmrs_scan_payload_0x2202.bin").read_bytes()
    session = ready_session(scan_rate_hz=12.5, last_angle_deg=-50.0)
    [frame] = session.receive_data(encode(Message(DataType.SCAN, payload)), 10**12)
    real = read_scan(payload)
    assert frame.scan_period_ns == pytest.approx(80_000_000, rel=0.002)
    assert np.count_nonzero(~np.isnan(frame.range_m)) == 70
    assert frame.arrived_ns - frame.stamp_ns == pytest.approx(22_190_000, abs=10_000)
    assert session.counters == {"scans_received": 1, "scans_truncated": 1}
    assert real.flags == ScanFlag.DIRT_LABELLED


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


def test_first_scan_of_the_side_not_wanted_is_a_sign_of_life_all_the_same():
    session = ready_session(mirror_sides="rear")
    for tick in range(25):
        session.tick(50 * SECOND_NS + tick * 200_000_000)
    frames, _ = frames_of(scan(), session=session)
    session.tick(55 * SECOND_NS)
    assert frames == []
    assert session.counters["scans_of_other_mirror_side"] == 1


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


def test_other_messages_are_passed_over_and_counted():
    session = ready_session()
    for data_type in (0x2221, 0x2805, 0x2806, 0x6420, 0x7100, 0x2807, 0x4711):
        session.receive_data(encode(Message(data_type, bytes(46))), 1)
    assert session.counters == {
        "object_lists_ignored": 1,
        "vehicle_states_ignored": 2,
        "log_texts_ignored": 1,
        "other_messages_ignored": 3,
    }


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
    t.run(20.0)
    assert t.session.status == "streaming; 31 C"


def test_sync_signal_that_is_missed_stands_in_the_status():
    t = talk(sync_angle_deg=0.0).run(2.0)
    assert "no external synchronisation signal" in t.session.status


def test_silence_is_a_transport_error():
    t = talk().run(3.0)
    t.device.silent = True
    with pytest.raises(TransportError, match="no scan for 2 s; is the device rebooting"):
        t.run(3.0)


def test_error_that_does_not_end_the_scans_is_no_reason_to_wait_with_a_new_link():
    t = talk().run(3.0)
    t.device.report(ErrorRegisters(errors_2=0x0040), t.now_ns)
    t.run(0.5)
    t.device.silent = True
    with pytest.raises(
        TransportError, match="no scan for 2 s, it reported processing timeout; is the device"
    ):
        t.run(3.0)


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


def look_on(session, now_ns, seconds):
    for k in range(50 * seconds):
        session.tick(now_ns + k * SECOND_NS // 50)


def test_silence_counts_only_while_we_look():
    t = talk().run(3.0)
    t.now_ns += 60 * SECOND_NS
    t.session.tick(t.now_ns)
    with pytest.raises(TransportError, match="no scan for 2 s"):
        look_on(t.session, t.now_ns, seconds=3)


def test_one_mirror_side_of_an_eight_layer_unit_has_half_the_rate():
    t = talk(mirror_sides="rear").run(3.0)
    assert {round(frame.scan_period_ns / 1e6) for frame in t.frames} == {80}
    assert set(np.rint(np.diff([frame.stamp_ns for frame in t.frames]) / 1e6)) == {80}
    assert t.session.counters["scans_of_other_mirror_side"] == pytest.approx(len(t.frames), abs=1)


@pytest.mark.parametrize("rate_hz", [12.5, 25.0, 50.0])
@pytest.mark.parametrize("resolution", ["constant", "focused"])
def test_frames_come_at_the_rate_asked_for_and_see_the_room_all_around(rate_hz, resolution):
    t = talk(scan_rate_hz=rate_hz, resolution=resolution).run(4.0)
    stamps_ns = np.array([frame.stamp_ns for frame in t.frames])
    assert np.diff(stamps_ns) == pytest.approx(1e9 / rate_hz, abs=1e4)
    frame = t.frames[-1]
    seen = ~np.isnan(frame.range_m)
    assert seen.sum() == (391 if resolution == "constant" else 396)
    np.testing.assert_allclose(frame.range_m[seen], 20.0, atol=0.011)
    assert t.session.counters["scans_missed"] == 0


def errors_ms(t, begin=0):
    """Stamp minus truth of each frame from `begin` on."""
    truth_ns = np.array(t.room.first_rays_ns)
    stamps_ns = np.array([frame.stamp_ns for frame in t.frames[begin:]])
    nearest = np.abs(stamps_ns[:, None] - truth_ns[None, :]).argmin(axis=1)
    return (stamps_ns - truth_ns[nearest]) / 1e6


def jitter(rng):
    """3 ms, and bursts of up to 50 ms."""
    return lambda: (
        round(rng.uniform(0.1e6, 3.1e6)) + (round(rng.uniform(0, 50e6)) if rng.random() < 0.05 else 0)
    )


NARROW = {"first_angle_deg": 10.0, "last_angle_deg": -10.0}  # what it sees is no matter, and quicker made


@pytest.mark.parametrize(
    ("set_clock", "rate_hz", "drift_ppm"),
    [
        (True, 12.5, 100.0),
        (False, 25.0, -100.0),
        (True, 50.0, 100.0),
        in_soak(False, 12.5, -100.0),
        in_soak(False, 25.0, 100.0),
        in_soak(True, 25.0, -100.0),
        in_soak(False, 50.0, -100.0),
        in_soak(False, 12.5, 100.0),
        in_soak(True, 12.5, -100.0),
        in_soak(True, 25.0, 100.0),
        in_soak(False, 50.0, 100.0),
        in_soak(True, 50.0, -100.0),
    ],
)
def test_stamps_are_those_of_the_first_ray_through_drift_and_jitter(set_clock, rate_hz, drift_ppm):
    t = talk(LuxSetup(clock_drift_ppm=drift_ppm), scan_rate_hz=rate_hz, set_clock=set_clock, **NARROW)
    t.delay_ns = jitter(np.random.default_rng(5))
    t.run(25.0)
    late_ms = errors_ms(t)
    after_10_s = late_ms[round(10 * rate_hz) :]
    assert len(after_10_s) > 12 * rate_hz
    assert np.std(after_10_s) <= 0.2
    assert np.mean(after_10_s) - LEAVES_AFTER_SWEEP_NS / 1e6 == pytest.approx(0.1, abs=0.2)


def test_restart_of_the_device_is_recovered_in_three_seconds():
    t = talk(LuxSetup(clock_drift_ppm=100.0, boot_ns=SECOND_NS))
    t.delay_ns = jitter(np.random.default_rng(6))
    t.run(20.0)
    before = len(t.frames)
    t.device.power_on(t.now_ns)
    back_ns = t.now_ns + 3 * SECOND_NS
    reconnect(t).run(20.0)
    first = next(k for k, frame in enumerate(t.frames) if k >= before and frame.stamp_ns > 0)
    assert t.frames[first].arrived_ns < back_ns
    after_3_s = next(k for k, frame in enumerate(t.frames) if frame.arrived_ns > back_ns)
    late_ms = errors_ms(t, after_3_s) - LEAVES_AFTER_SWEEP_NS / 1e6
    assert np.abs(late_ms).max() < 1.0
    assert np.std(errors_ms(t, after_3_s + 250)) <= 0.2
    assert np.diff([frame.stamp_ns for frame in t.frames]).min() > 0


def test_device_that_restarts_unseen_and_forgets_is_set_up_again():
    t = talk().run(5.0)
    t.device.power_on(t.now_ns)
    with pytest.raises(
        TransportError, match=r"11 scans in a row at 12[.]5 Hz from 50 to -60 deg, set was 25 Hz"
    ):
        t.run(3.0)
    reconnect(t).run(2.0)
    assert t.session.counters["scans_not_as_configured"] == 0


@pytest.mark.parametrize("kept", [True, False])
def test_clock_that_others_set_while_it_runs_is_followed(kept):
    """At once where the scan numbers go on, else once it is no late network."""
    t = talk(set_clock=False).run(10.0)
    if not kept:
        t.device.number_base += 20_000
    t.device._set_clock(ntp(4_000_000_000 * SECOND_NS), t.now_ns)
    before = len(t.frames)
    t.run(5.0)
    assert t.session.counters["clock_resets"] == 1
    assert np.abs(errors_ms(t, before + 1) - LEAVES_AFTER_SWEEP_NS / 1e6 - 0.1).max() < 0.1


GOOD = [
    wire(scan((1, 0, 0, 1600, 1000, 60), number=k, start_ns=10 * SECOND_NS + k * PERIOD_NS)) for k in range(3)
]
ERRORS = encode(Message(DataType.ERRORS, ErrorRegisters(errors_1=2).write()))
STATUS = encode(Message(DataType.REPLY, bytes.fromhex("0100") + bytes(30)))


@given(data=st.data())
@settings(suppress_health_check=[HealthCheck.too_slow])
def test_mutated_messages_do_no_harm_and_the_next_good_scan_is_a_frame(data):
    session = IbeoLuxSession(config(), lambda: 0)
    if data.draw(st.booleans()):
        made_ready(session)
    spoilt = bytearray(data.draw(st.sampled_from([GOOD[0], ERRORS, STATUS])))
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(0, len(spoilt) - 1))
        spoilt[place] = data.draw(st.integers(0, 255))
    for k, message in enumerate([GOOD[0], bytes(spoilt), GOOD[1]]):
        now_ns = 10**12 + k * PERIOD_NS
        session.tick(now_ns)
        for frame in session.receive_data(message, now_ns):
            assert len(frame.range_m) <= 1 + 11_520 // 4
            assert frame.beam_interval_ns > 0
    made_ready(session)
    [frame] = session.receive_data(GOOD[2], 10**12 + 3 * PERIOD_NS)
    assert np.count_nonzero(~np.isnan(frame.range_m)) == 1


def test_link_that_breaks_is_made_again():
    def cut_once(count, port_wire):
        if count == 5:
            port_wire.cut()
            port_wire.restore()

    frames, health = frames_over_tcp(
        "ibeo_lux", FakeIbeoLux(Room(), LuxSetup()), config, enough=60, at_frame=cut_once
    )
    assert len(frames) >= 60  # one read may bring several
    assert health.connects == 2
    assert np.diff([frame.stamp_ns for frame in frames]).min() > 0
