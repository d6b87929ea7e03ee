"""The session against the fake device in virtual time: start-up from any state, frames, faults."""

import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from drivers.errors import DeviceError, ProtocolError, TransportError
from drivers.frames import CAUSES, causes_of
from drivers.hokuyo_utm30lx.driver import MALFORMED_LIMIT, HokuyoUtm30lxSession
from drivers.hokuyo_utm30lx.protocol import encode_reply
from drivers.hokuyo_utm30lx.scans import Scan, ScanRequest, write_scan
from simulators.device import Sweep
from simulators.hokuyo_setup import Utm30lxSetup
from simulators.hokuyo_utm30lx import FakeUtm30lx
from tests.drivers.utm30lx import NARROW, Room, config, talk
from tests.drivers.virtual_time import Talk
from tests.soaked import every_other

USB, ETHERNET = Utm30lxSetup(), Utm30lxSetup(wire="ethernet", serial_number="H0123456", no_return_mm=65_533)
HOST = "192.168.0.10"


def test_scans_come_at_40_hz_with_1081_beams_and_say_who_measured_them():
    t = talk().run(4.0)
    frame = t.frames[-1]
    assert len(t.frames) >= 40 * 2.9
    assert frame.sensor == "rear"
    assert len(frame.range_m) == 1081
    assert frame.first_angle_rad == pytest.approx(math.radians(-135.0))
    assert frame.angle_step_rad == pytest.approx(math.radians(0.25))
    assert frame.beam_interval_ns == pytest.approx(17_361, abs=10)
    assert frame.scan_period_ns == pytest.approx(25_000_000, rel=1e-3)
    assert (frame.range_min_m, frame.range_max_m) == (0.1, 30.0)
    assert frame.intensity.shape == (0,)
    assert np.isnan(frame.range_m[::10]).all()
    seen = np.delete(np.arange(1081), np.s_[::10])
    np.testing.assert_array_equal(frame.range_m[seen], np.float32(1.0 + seen * 1e-3))
    assert frame.range_m.dtype == frame.intensity.dtype == np.float32
    assert t.session.status == "streaming"
    assert t.session.identity == {
        "product": "SOKUIKI Sensor TOP-URG UTM-30LX",
        "firmware": "P.1.05(17/Apr./2009)",
        "protocol": "SCIP 2.0",
        "serial": "00903971",
    }
    assert t.session.counters["scans_missed"] == 0
    assert t.session.counters["beams_no_return"] == 109 * len(t.frames)
    assert t.session.clock_offset_ns is not None


def test_cluster_skip_and_field_of_view_are_asked_for_and_understood():
    t = talk(cluster=3, skip_scans=1, first_angle_deg=-90.0, last_angle_deg=90.0).run(4.0)
    frame = t.frames[-1]
    assert b"MD0180090003100\n" in t.sent
    assert len(frame.range_m) == 241
    assert frame.angle_step_rad == pytest.approx(math.radians(0.75))
    assert frame.first_angle_rad == pytest.approx(math.radians(-90.0 + 0.25))  # middle of three
    assert frame.beam_interval_ns == pytest.approx(3 * 17_361, abs=30)
    assert frame.scan_period_ns == pytest.approx(50_000_000, rel=1e-3)
    assert t.session.counters["scans_missed"] == 0
    assert not np.isnan(frame.range_m[:-1]).any()  # the nearest of three that has one; the last is alone


class Panes:
    """Beam 0 sees nothing, beam 1 one echo at 2 m."""

    def sweep(self, beams):
        range_m = np.full(beams.count, 2.0, np.float32)
        range_m[0] = np.nan
        return Sweep(range_m, np.full(beams.count, 0.5, np.float32))


def frame_of(rows_mm, rows_intensity=None, **changes):
    """The frame made of one hand-made multi-echo scan."""
    t = Talk(HokuyoUtm30lxSession(config(host=HOST, **changes)), FakeUtm30lx(Panes(), ETHERNET)).connect()
    t.run(5.0, until=lambda: t.frames != [])
    request = ScanRequest(config(host=HOST, **changes).scan_command, 0, 1080)
    distance_mm = np.full((3, 1081), -1, np.int32)
    distance_mm[0] = 5000
    intensity = np.where(distance_mm >= 0, 100, -1).astype(np.int32)
    for row, (values, strengths) in enumerate(zip(rows_mm, rows_intensity or rows_mm, strict=True)):
        distance_mm[row, : len(values)] = values
        intensity[row, : len(values)] = strengths
    scan = Scan(request, 999_999, distance_mm, intensity if request.with_intensity else distance_mm[:0])
    (frame,) = t.session.receive_data(write_scan(scan), t.now_ns + 70_000_000)
    return frame, t.session


DISTANCES = ([1000, 1000, 1, 1000], [2000, 65_533, 3000, -1], [2500, -1, 2, -1])


def test_the_last_echo_is_the_last_that_is_a_distance():
    frame, session = frame_of(DISTANCES, echo="last")
    np.testing.assert_array_equal(frame.range_m[:5], np.float32([2.5, 1.0, 3.0, 1.0, 5.0]))
    assert session.counters["beams_with_further_echoes"] >= 3


def test_the_strongest_echo_is_chosen_among_distances_and_brings_its_intensity():
    strengths = ([100, 100, 900, 300], [500, 800, 200, -1], [400, -1, 900, -1])
    frame, _ = frame_of(DISTANCES, strengths, echo="strongest", intensity=True)
    np.testing.assert_array_equal(frame.range_m[:5], np.float32([2.0, 1.0, 3.0, 1.0, 5.0]))
    np.testing.assert_array_equal(frame.intensity[:5], np.float32([500, 100, 200, 300, 100]))
    frame, _ = frame_of(DISTANCES, strengths, echo="strongest")
    assert frame.intensity.shape == (0,)


def test_error_codes_become_nan_and_counted_reasons():
    t = talk().run(5.0)
    distance_mm = np.full((1, 1081), 4000, np.int32)
    distance_mm[0, :9] = [0, 1, 2, 3, 4, 5, 22, 23, 60_000]
    before = t.session.counters.copy()
    scan = Scan(ScanRequest("MD", 0, 1080), 999_999, distance_mm, distance_mm[:0])
    (frame,) = t.session.receive_data(write_scan(scan), t.now_ns)
    assert np.isnan(frame.range_m[:7]).all()
    causes = [CAUSES[cause] for cause in causes_of(frame.range_m)[:7]]
    assert causes[:5] == ["other_error", "no_return", "too_near", "interference", "near_limit"]
    assert causes[5:] == ["other_error", "other_error"]
    assert frame.range_m[7] == np.float32(0.023)
    assert np.isnan(frame.range_m[8])
    counted = t.session.counters - before
    assert {name: count for name, count in counted.items() if name.startswith("beams")} == {
        "beams_no_return": 1,
        "beams_too_near": 1,
        "beams_interference": 1,
        "beams_near_limit": 1,
        "beams_other_error": 3,
        "beams_beyond_range": 1,
    }


@pytest.mark.parametrize(
    ("setup", "changes"),
    [
        (replace(USB, boot_ns=2_000_000_000, warm_up_ns=3_000_000_000), {}),
        (replace(ETHERNET, boot_ns=6_000_000_000, warm_up_ns=1_000_000_000), {"host": HOST}),
        (replace(USB, scip_1=True), {}),
        (replace(USB, sums_count_semicolons=True), {}),
        (replace(USB, cuts_scan_on_quit=True), {}),
    ],
)
def test_a_device_in_any_state_of_its_start_comes_to_stream(setup, changes):
    t = talk(setup, **NARROW, **changes)
    t.run(16.0, until=lambda: len(t.frames) > 40)
    assert t.session.status == "streaming"
    assert "resets" not in t.session.counters


class Stuck(FakeUtm30lx):
    """Refuses to end what it does until it is reset."""

    stuck = True

    def receive_data(self, data, now_ns):
        self.stuck &= b"RS\n" not in data
        if self.stuck and b"QT\n" in data:
            return encode_reply("QT", "10")
        return super().receive_data(data, now_ns)


def test_a_unit_that_nothing_else_frees_is_reset():
    t = Talk(HokuyoUtm30lxSession(config()), Stuck(Room(), USB)).connect().run(10.0)
    assert t.session.status == "streaming"
    assert t.session.counters["resets"] == 1
    assert t.session.counters["clock_resets"] == t.session.counters["time_sync_contradictory"] == 0


LEFT_WITH = (
    b"ME0000108001000\n",
    b"MD0000108001000\n",  # even the very stream we want, but not ours
    b"TM0\n",
    b"MD00001080",  # half a command
    b"BM\nGD0000108001\n",
)


@pytest.mark.parametrize(("cuts", "left_with"), every_other(product([False, True], LEFT_WITH)))
def test_a_usb_unit_left_in_any_state_by_a_dead_client_is_taken_over(cuts, left_with):
    device = FakeUtm30lx(Room(), replace(USB, cuts_scan_on_quit=cuts))
    now_ns = 1_000_000_000_000
    device.connected(now_ns)
    device.receive_data(left_with, now_ns)
    device.disconnected(now_ns + 500_000_000)
    t = Talk(HokuyoUtm30lxSession(config()), device, now_ns=now_ns + 900_000_000)
    if left_with.startswith(b"M") and left_with.endswith(b"\n"):
        assert device.next_due_ns(now_ns) is not None  # it streams on
    t.connect().run(4.0)
    assert t.sent.startswith(b"\n")  # ends a half-sent command
    assert t.session.status == "streaming"
    assert t.session.counters["scans_malformed"] == 0
    assert np.diff([frame.stamp_ns for frame in t.frames]).max() < 26_000_000


def test_only_the_unit_with_the_configured_serial_number_is_taken():
    assert talk(serial_number="00903971").run(3.0).frames
    assert talk(ETHERNET, host=HOST, serial_number="h0123456").run(3.0).frames
    with pytest.raises(DeviceError, match=r"unit 00903971, expected serial_number 00906000.*/dev/ttyACM0"):
        talk(serial_number="00906000").run(3.0)


def test_a_laser_that_does_not_light_is_reported_after_some_attempts():
    t = talk()
    t.device.laser_broken = True
    with pytest.raises(DeviceError, match="laser does not light"):
        t.run(60.0)
    assert t.sent.count(b"BM\n") == 10


def test_an_abnormal_device_is_rebooted_and_the_next_connection_streams():
    device = FakeUtm30lx(Room(), replace(USB, boot_ns=1_000_000_000))
    t = Talk(HokuyoUtm30lxSession(config()), device).connect()
    device.abnormal = True
    with pytest.raises(DeviceError, match=r"abnormal state.*Trouble!! Error No.*rebooted"):
        t.run(5.0)
    assert device.counters["reboots"] == 1
    again = Talk(HokuyoUtm30lxSession(config()), device, now_ns=t.now_ns + 10_000_000_000).connect().run(4.0)
    assert again.session.status == "streaming"


def test_an_unsteady_motor_is_reported_in_the_end():
    with pytest.raises(DeviceError, match="unstable"):
        talk(replace(USB, warm_up_ns=3_600_000_000_000)).run(120.0)


def test_hardware_fault_in_the_stream_is_a_device_error():
    t = talk().run(4.0)
    t.device.fault_status = "54"
    with pytest.raises(DeviceError, match="status 54"):
        t.run(1.0)


def test_a_device_that_stops_to_verify_an_error_is_waited_for():
    t = talk().run(4.0)
    t.device.fault_status = "21"
    t.run(1.0)
    assert t.session.status == "streaming; stopped to verify an error (status 21)"
    before, t.device.fault_status = len(t.frames), ""
    t.run(1.0)
    assert t.session.status == "streaming"
    assert len(t.frames) > before + 30
    assert t.session.counters["stops_to_verify_an_error"] == 1


def test_scans_that_another_program_asked_for_are_named():
    t = talk().run(4.0)
    before = len(t.frames)
    t.device.receive_data(b"MD0044108000000\n", t.now_ns)
    with pytest.raises(
        TransportError, match=r"8\d scans came in 2 s, all of another request.*another program"
    ):
        t.run(3.0)
    assert len(t.frames) == before


def test_line_that_damages_every_scan_is_distinguished_from_one_that_is_cut():
    t = talk().run(4.0)
    deliver = t.session.receive_data
    t.session.receive_data = lambda data, arrived_ns: deliver(b"?" + data[1:], arrived_ns)
    with pytest.raises(TransportError, match=r"8\d scans came in 2 s, all damaged on the way; look at plugs"):
        t.run(3.0)


def test_one_bad_block_costs_one_scan():
    t = talk().run(4.0)
    wires = [t.device.due(t.device.next_due_ns(t.now_ns)) for _ in range(5)]
    wires[1] = wires[1][:800] + b"~" + wires[1][801:]
    wires[3] = wires[3][:500] + wires[3][700:]
    frames = [
        frame
        for i, wire in enumerate(wires)
        for frame in t.session.receive_data(wire, t.now_ns + i * 25_000_000)
    ]
    assert len(frames) == 3
    assert t.session.counters["scans_malformed"] == 2
    assert t.session.counters["scans_missed"] == 2


def test_statuses_that_end_a_stream_and_those_that_are_noise():
    t = talk().run(4.0)
    for noise in ("01", "0Z", "99"):
        assert t.session.receive_data(encode_reply("MD0000108001000", noise), t.now_ns) == []
    assert t.session.receive_data(encode_reply("MD0000108001000", "54", [b"<Sfk", b"000"]), t.now_ns) == []
    assert t.session.receive_data(encode_reply("ME0000108001000", "54"), t.now_ns) == []  # not our stream
    with pytest.raises(TransportError, match="denied"):
        t.session.receive_data(encode_reply("MD0000108001000", "10"), t.now_ns)
    with pytest.raises(DeviceError, match="abnormal state"):
        t.session.receive_data(encode_reply("MD0000108001000", "0L"), t.now_ns)


def test_nothing_but_malformed_scans_ends_the_session():
    t = talk().run(4.0)
    bad = encode_reply("MD0000108001000", "99", [b"0000", b"000"])
    for _ in range(MALFORMED_LIMIT):
        assert t.session.receive_data(bad, t.now_ns) == []
    with pytest.raises(ProtocolError, match="malformed scans in a row"):
        t.session.receive_data(bad, t.now_ns)


def test_shutdown_request_ends_the_stream_a_usb_unit_would_go_on_with():
    t = talk().run(4.0)
    assert t.device.next_due_ns(t.now_ns) is not None
    t.device.receive_data(t.session.shutdown_request(), t.now_ns)
    assert t.device.next_due_ns(t.now_ns) is None
    assert HokuyoUtm30lxSession(config()).shutdown_request() == b""


@pytest.mark.parametrize("by_s", [-676.0, 676.0, -2.0, 0.7])
def test_a_clock_set_between_time_sync_and_stream_costs_the_calibration_alone(by_s):
    t = talk()
    hear = t.device.receive_data

    def jump_before_the_laser_is_lit(data, now_ns):
        if data == b"BM\n":
            t.device.jump_clock(by_s)
        return hear(data, now_ns)

    t.device.receive_data = jump_before_the_laser_is_lit
    t.run(12.0)
    assert t.session.status == "streaming"
    assert t.session.counters["time_sync_contradictory"] == 1
    assert t.session.counters["scans_out_of_order"] == 0
    lag_ms = [(frame.arrived_ns - frame.stamp_ns) / 1e6 for frame in t.frames[-200:]]
    assert len(lag_ms) == 200
    assert 18.0 < min(lag_ms) <= max(lag_ms) < 24.0


def test_a_damaged_answer_to_the_scan_command_is_asked_for_again():
    t = talk()
    answer, damaged = t.device.receive_data, []

    def damage_the_first(data, now_ns):
        answered = answer(data, now_ns)
        if data.startswith(b"MD") and not damaged:
            damaged.append(data)
            return answered.replace(b"\n00", b"\n0~", 1)
        return answered

    t.device.receive_data = damage_the_first
    t.run(4.0)
    assert damaged
    assert t.session.status == "streaming"
    assert t.session.counters["requests_unanswered"] >= 1
    assert np.diff([frame.stamp_ns for frame in t.frames]).max() < 26_000_000
