"""Scan telegrams into frames: values, flags, stamps; and the whole driver over loopback."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from drivers.errors import ProtocolError, TransportError
from drivers.frames import CAUSES, causes_of
from drivers.sick_lms100.driver import Lms100Session
from drivers.sick_lms100.protocol import Dialect, encode
from drivers.sick_lms100.telegrams import Channel, write_scan
from tests.drivers.lms100 import config, telegram
from tests.drivers.virtual_time import SECOND_NS

ASCII, BINARY = Dialect.ASCII, Dialect.BINARY
BEAM_INTERVAL_NS = 27_778
SWEEP_US = 15_000  # 270 deg at 50 Hz


def frames_of(*scans, session=None, arrived_after_ns=1_000_000, dialect=ASCII, **changes):
    session = session or Lms100Session(config(**changes))
    frames = []
    for scan in scans:
        arrived_ns = scan.sent_us * 1000 + arrived_after_ns
        frames += session.receive_data(encode(write_scan(scan, dialect)), arrived_ns)
    return frames, session


@pytest.mark.parametrize("dialect", [ASCII, BINARY])
def test_frame_carries_what_the_telegram_says(dialect):
    [frame], session = frames_of(telegram(), dialect=dialect, range_max_m=25.0)
    assert (frame.sensor, frame.arrived_ns) == ("front", 1_016_300_000)
    assert frame.stamp_ns == 1_001_000_000  # first beam, late by the shortest delay
    assert (frame.beam_interval_ns, frame.scan_period_ns) == (BEAM_INTERVAL_NS, 20_000_000)
    assert frame.first_angle_rad == pytest.approx(math.radians(-135.0))
    assert frame.angle_step_rad == pytest.approx(math.radians(0.5))
    assert (frame.range_min_m, frame.range_max_m) == (0.05, 25.0)
    np.testing.assert_array_equal(frame.range_m, np.full(541, 1.5, np.float32))
    assert frame.range_m.dtype == np.float32
    assert frame.intensity.shape == (0,)
    assert session.clock_offset_ns == 1_000_000


def test_codes_that_are_no_distance_become_nan_and_are_counted():
    [frame], session = frames_of(telegram(values=(0, 0, 1, 2, 3, 4, 15, 16, 65_535)))
    assert np.isnan(frame.range_m).tolist() == [True] * 7 + [False] * 2
    causes = [CAUSES[cause] for cause in causes_of(frame.range_m)[1:7]]
    assert causes == ["no_return", "dazzled", "implausible", "filtered", "reserved_code", "reserved_code"]
    assert frame.range_m[-2:].tolist() == [np.float32(0.016), np.float32(65.535)]
    counted = {name: count for name, count in session.counters.items() if name.startswith("beams")}
    assert counted == {
        "beams_no_echo": 2,
        "beams_dazzled": 1,
        "beams_implausible": 1,
        "beams_filtered": 1,
        "beams_reserved_code": 2,
    }


def test_scale_and_offset_are_applied():
    channel = Channel("DIST1", np.array([15, 20_000], dtype=np.uint16), -450_000, 5000, 2.0, 10.0)
    [frame], _ = frames_of(telegram(channels_16bit=(channel,)))
    assert np.isnan(frame.range_m[0])
    assert frame.range_m[1] == np.float32(40.01)


def two_echoes(bits):
    def channel(content, *values):
        return Channel(content, np.array(values, dtype=np.uint16), -450_000, 5000)

    distances = channel("DIST1", 1000, 1000, 0), channel("DIST2", 2000, 0, 0)
    remissions = channel("RSSI1", 10, 20, 0), channel("RSSI2", 30, 0, 0)
    if bits == 16:
        return {"channels_16bit": distances + remissions}
    return {"channels_16bit": distances, "channels_8bit": remissions}


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize(
    ("echo", "range_m", "intensity"),
    [("first", [1.0, 1.0, np.nan], [10.0, 20.0, 0.0]), ("last", [2.0, 1.0, np.nan], [30.0, 20.0, 0.0])],
)
def test_echo_and_its_intensity_are_chosen(bits, echo, range_m, intensity):
    [frame], _ = frames_of(telegram(**two_echoes(bits)), echo=echo)
    np.testing.assert_array_equal(frame.range_m, np.array(range_m, np.float32))
    np.testing.assert_array_equal(frame.intensity, np.array(intensity, np.float32))


@pytest.mark.parametrize(
    ("shots", "interval_ns"), [(360, 27_778), (36_000, 27_778), (0, 27_778), (720, 27_778)]
)
def test_beam_interval_is_right_whatever_unit_the_firmware_takes(shots, interval_ns):
    [frame], session = frames_of(telegram(shots_100hz=shots))
    assert frame.beam_interval_ns == interval_ns
    assert session.counters["scans_odd_measurement_frequency"] == (shots in (0, 720))


@pytest.mark.parametrize("dialect", [ASCII, BINARY])
def test_scan_that_states_a_rate_of_0_hz_is_dropped_and_counted(dialect):
    scans = [telegram(counter, counter * 20_060) for counter in range(100, 110)]
    scans[5] = replace(scans[5], frequency_chz=0)
    frames, session = frames_of(*scans, dialect=dialect)
    assert len(frames) == 9
    assert session.counters["scans_without_scan_rate"] == 1
    assert session.counters["scans_received"] == 10
    assert session.counters["scans_not_as_configured"] == 0


@pytest.mark.parametrize("field_of_view", [(0, 541), (90, 361)])
def test_zero_index_behind_the_sweep_puts_the_first_beam_a_sweep_before_the_sending(field_of_view):
    skipped, count = field_of_view
    channel = Channel("DIST1", np.full(count, 900, np.uint16), -450_000 + 5000 * skipped, 5000)
    scan = telegram(sent_after_us=3_100, channels_16bit=(channel,))
    [frame], _ = frames_of(scan)
    assert frame.stamp_ns == pytest.approx(
        (scan.sent_us - SWEEP_US) * 1000 + 1_000_000 + skipped * BEAM_INTERVAL_NS, abs=1_000
    )


def stale_scan(k):
    """Of a device that still measured at 25 Hz when the connection was made."""
    return telegram(k, k * 40_000, sent_after_us=3_100, frequency_chz=2500)


def delayed_scan(k):
    """The device was busy, and sent it 16 ms after the zero index."""
    return telegram(k, k * 20_000, sent_after_us=16_000)


@pytest.mark.parametrize("first_scan", [stale_scan, delayed_scan])
def test_first_scan_of_a_connection_does_not_decide_alone_where_the_first_beam_lies(first_scan):
    session = Lms100Session(config())
    frames_of(first_scan(4), session=session)
    scans = [telegram(k, k * 20_000, sent_after_us=3_100) for k in range(10, 20)]
    frames, _ = frames_of(*scans, session=session)
    for frame, scan in zip(frames, scans, strict=True):
        assert frame.stamp_ns == pytest.approx((scan.sent_us - SWEEP_US) * 1000 + 1_000_000, abs=1_000)


def test_repeated_scan_is_dropped_and_missing_ones_are_counted():
    scans = [telegram(counter, counter * 20_060) for counter in (65_534, 65_535, 65_535, 0, 3)]
    scans[3] = telegram(0, 65_536 * 20_060)
    scans[4] = telegram(3, 65_539 * 20_060)
    frames, session = frames_of(*scans)
    assert len(frames) == 4
    assert session.counters["scans_duplicate"] == 1
    assert session.counters["scans_missed"] == 2


def test_counters_and_clock_that_jump_back_are_a_restart_of_the_device():
    session = Lms100Session(config())
    scans = [telegram(counter, 5_000_000 + counter * 20_060) for counter in range(50, 60)]
    first, _ = frames_of(*scans, session=session)
    again, _ = frames_of(*scans, session=session, arrived_after_ns=1_000_000 + SECOND_NS)
    assert len(first) == len(again) == 10
    assert session.counters["clock_resets"] == 1
    assert session.counters["scan_counter_restarts"] == 1
    assert again[0].stamp_ns > first[-1].stamp_ns


def test_one_malformed_scan_is_counted_and_twenty_one_are_a_protocol_error():
    bad = encode(write_scan(telegram(channels_16bit=()), BINARY))
    session = Lms100Session(config())
    for _ in range(20):
        assert session.receive_data(bad, 1) == []
    assert session.counters["scans_malformed"] == 20
    with pytest.raises(ProtocolError, match="expected DIST1"):
        session.receive_data(bad, 1)


@pytest.mark.parametrize("content", ["DIST1", "RSSI1"])
@pytest.mark.parametrize(
    ("scale", "offset"),
    [(0.0, 0.0), (-1.0, 0.0), (math.nan, 0.0), (math.inf, 0.0), (3e38, 0.0), (1.0, math.nan)],
)
def test_channel_whose_scale_or_offset_makes_no_numbers_is_malformed(content, scale, offset):
    channels = [Channel(name, np.full(9, 1500, np.uint16), -450_000, 5000) for name in ("DIST1", "RSSI1")]
    odd = [replace(c, scale=scale, offset=offset) if c.content == content else c for c in channels]
    frames, session = frames_of(telegram(channels_16bit=tuple(odd)), intensity_bits=16)
    assert frames == []
    assert session.counters["scans_malformed"] == 1


def part_of_the_view(counter, first_e4deg=-450_000, count=541):
    """Scan number `counter`, of `count` beams of half a degree."""
    channel = Channel("DIST1", np.full(count, 1500, np.uint16), first_e4deg, 5000)
    return telegram(counter, counter * 20_060, channels_16bit=(channel,))


NARROWED = {"first_e4deg": 450_000, "count": 181}


@pytest.mark.parametrize("changed", [NARROWED, {"count": 361}, {"first_e4deg": -400_000, "count": 531}])
def test_field_of_view_that_another_host_changed_ends_the_connection_after_eleven_scans(changed):
    session = Lms100Session(config())
    frames_of(*(part_of_the_view(k) for k in range(1, 6)), session=session)
    frames_of(*(part_of_the_view(k, **changed) for k in range(6, 16)), session=session)
    assert session.counters["scans_not_as_configured"] == 10
    assert session.status == "streaming"
    words = r"11 scans in a row at 50 Hz and 0\.5 deg from .* deg, set was 50 Hz .* from -135 to 135 deg"
    with pytest.raises(TransportError, match=words):
        frames_of(part_of_the_view(16, **changed), session=session)


# Time, with a device whose truth is known


def test_recorded_lms111_plays_through_the_session(shared):
    rows = [
        json.loads(line) for line in (shared / "captures/sick/20210302_lms111.jsonl").read_text().splitlines()
    ]
    session, frames = Lms100Session(config()), []
    for row in rows:
        if row["dir"] == "dev":
            frames += session.receive_data(bytes.fromhex(row["hex"]), 10**12 + round(row["t"] * 1e9))
    repeated = session.counters["scans_duplicate"]
    assert repeated == 3
    assert len(frames) == 175 - repeated
    assert session.counters["scans_missed"] == 0
    assert session.counters["scans_flagged_device_error"] == 7
    assert {len(frame.range_m) for frame in frames} == {541}
    assert all((frame.arrived_ns - frame.stamp_ns) > SWEEP_US * 1000 - 200_000 for frame in frames)
    step_ms = np.diff([frame.stamp_ns for frame in frames[100:]]) / 1e6
    assert ((step_ms > 20.06) & (step_ms < 20.19)).all()
