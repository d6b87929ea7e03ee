"""Data into frames: axes, units, gaps of each stream, words for what the device says."""

import math
from pathlib import Path

import pytest

from drivers.errors import ProtocolError, TransportError
from drivers.xsens_mtig.driver import MALFORMED_LIMIT
from drivers.xsens_mtig.mtdata2 import Kind, join, write_item
from drivers.xsens_mtig.protocol import MessageDecoder, Mid, encode
from simulators.xsens_mtig import MtigSetup
from tests.drivers.mtig import GOOD_PVT, PLACE, YAW_RAD, Swing, fixes, legacy, mtdata2, samples, talk
from tests.drivers.virtual_time import Talk

FORMATS = ("float32", "fp12.20", "fp16.32", "float64")
BOTH = pytest.mark.parametrize("make", [mtdata2, legacy])


def yaw_rad(quaternion):
    w, x, y, z = quaternion
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


@pytest.mark.parametrize(
    ("make", "number_format"), [*((mtdata2, f) for f in FORMATS), *((legacy, f) for f in FORMATS[:3])]
)
def test_samples_are_in_si_units_forward_left_up_whatever_the_format(make, number_format):
    t = talk(make(baud=921_600), number_format=number_format, latency_ms=1.0).run(5.0)
    sample = samples(t.frames)[-1]
    assert sample.rate_radps == pytest.approx((0.1, -0.2, 5.0), abs=0.02)
    assert sample.force_mps2 == pytest.approx((0.3, 0.5, 9.81), abs=1e-4)
    assert yaw_rad(sample.orientation_wxyz) == pytest.approx(YAW_RAD, abs=1e-4)
    assert sample.sensor == "imu"
    fix = fixes(t.frames)[-1]
    assert (fix.latitude_deg, fix.longitude_deg) == pytest.approx((60.161, 24.546), abs=2e-7)
    assert fix.altitude_m == pytest.approx(52.0, abs=1e-3)
    assert fix.covariance[0] == pytest.approx(PLACE.horizontal_accuracy_m**2)
    assert fix.covariance[8] == pytest.approx(PLACE.vertical_accuracy_m**2)
    assert fix.status == 0


@pytest.mark.parametrize("frame", [0x0, 0x4, 0x8])
@pytest.mark.parametrize("kind", [Kind.QUATERNION, Kind.EULER, Kind.MATRIX])
def test_orientation_is_that_of_enu_from_every_frame_and_form(frame, kind):
    device = mtdata2(baud=None)
    wanted = [(0x1060, 0xFFFF), (kind | frame, 100), (0x4020, 100), (0x8020, 100)]
    device.settings.output = wanted
    t = talk(device, configure=False, device="usb").run(2.0)
    sample = samples(t.frames)[-1]
    assert yaw_rad(sample.orientation_wxyz) == pytest.approx(YAW_RAD, abs=1e-5)
    assert abs(sample.orientation_wxyz[1]) < 1e-6
    assert abs(sample.orientation_wxyz[2]) < 1e-6
    assert sample.force_mps2[2] == pytest.approx(9.81, abs=1e-5)  # its own axes are the same in all frames


@pytest.mark.parametrize("bits", [0x0, 0x8000_0000])
@pytest.mark.parametrize("form", [0, 1, 2])
def test_legacy_orientation_north_west_up_or_ned_becomes_that_of_enu(bits, form):
    device = legacy(baud=None)
    device.settings.write(Mid.OUTPUT_SETTINGS, (bits | form << 2 | 1).to_bytes(4, "big"))
    t = talk(device, configure=False, device="usb").run(2.0)
    assert yaw_rad(samples(t.frames)[-1].orientation_wxyz) == pytest.approx(YAW_RAD, abs=1e-5)


@BOTH
def test_without_satellites_there_are_fixes_that_say_so(make):
    device = make()
    device.source = Swing(None)
    t = talk(device).run(2.0)
    assert len(fixes(t.frames)) >= 5
    for fix in fixes(t.frames):
        assert fix.status == -1
        assert all(map(math.isnan, (fix.latitude_deg, fix.longitude_deg, fix.altitude_m)))
        assert not any(fix.covariance)
    assert "no GNSS fix" in t.session.status


def test_receivers_without_a_good_fix_give_no_place():
    t = talk(mtdata2()).run(1.0)
    pvt = GOOD_PVT._replace(flags=0)
    assert place_of(t, pvt).status == -1
    assert "not good enough" in t.session.status
    assert place_of(t, GOOD_PVT._replace(fix=1)).status == -1
    assert place_of(t, GOOD_PVT._replace(horizontal_accuracy_mm=0xFFFF_FFFF)).status == -1
    assert place_of(t, GOOD_PVT._replace(flags=3)).status == 1
    assert place_of(t, GOOD_PVT._replace(fix=2)).status == 0


def test_fixes_are_stamped_with_the_receivers_moment_not_the_messages():
    t = talk(mtdata2(baud=921_600), latency_ms=1.0).run(5.0)
    settled = fixes(t.frames)[4:]
    assert len(settled) >= 10  # four a second
    for fix in settled:
        assert fix.arrived_ns - fix.stamp_ns > 45_000_000
        utc_ns = MtigSetup().utc_at_start_ns + fix.stamp_ns
        assert (utc_ns + 231_000 + 125_000_000) % 250_000_000 - 125_000_000 == pytest.approx(0, abs=600_000)


def lost(session, *names):
    return {name: session.counters[name] for name in names}


def test_gaps_are_counted_for_each_stream_on_its_own():
    device = mtdata2()
    t = talk(device).run(3.0)
    names = ("messages_missed", "samples_missed", "fixes_missed")
    assert lost(t.session, *names) == dict.fromkeys(names, 0)
    device.lose_messages(3)
    t.run(0.1)
    assert t.session.counters["messages_missed"] == 3
    assert t.session.counters["samples_missed"] + t.session.counters["fixes_missed"] == 3
    before = t.session.counters["samples_missed"]
    t.session.receive_data(b"", t.now_ns)
    t.run(0.5)
    assert t.session.counters["samples_missed"] == before
    device.lose_messages(104)  # half a second: 100 samples or more and two solutions
    t.run(2.0)
    assert t.session.counters["messages_missed"] == 107
    assert t.session.counters["fixes_missed"] >= 2
    assert t.session.counters["samples_missed"] + t.session.counters["fixes_missed"] == 107


@pytest.mark.parametrize("counts_skipped", [False, True])
def test_legacy_unit_that_skips_samples_is_stamped_right_however_it_counts(counts_skipped):
    t = talk(legacy(counts_skipped=counts_skipped, baud=460_800), rate_hz=50, latency_ms=1.0).run(6.0)
    for sample in samples(t.frames)[100:]:
        assert sample.stamp_ns * 1e-9 - 1000.0 == pytest.approx(sample.rate_radps[2], abs=0.5e-3)
    assert t.session.counters["samples_missed"] == 0


def test_errors_warnings_and_clipping_are_reported_and_forgotten():
    device = mtdata2(baud=460_800)
    t = talk(device).run(1.0)
    device.send_error(0x28, t.now_ns)
    device.clipped = 0x0100
    t.run(0.1)
    assert t.session.status.startswith("streaming; error 0x28: device error, filter valid")
    assert t.session.counters["device_errors"] == 1
    assert t.session.counters["samples_clipped_acceleration"] >= 15
    device.send_warning(402, "GNSS timeout", t.now_ns)
    t.run(0.1)
    assert "warning 402: GNSS timeout" in t.session.status
    t.run(11.0)
    assert t.session.status == "streaming; filter valid, GNSS 3D fix (9 satellites)"


@pytest.mark.parametrize(
    ("status", "words"),
    [
        (0b00010, "self-test failed: have it repaired, filter valid"),
        (0b00001, "filter not settled"),
        (0b11011, "filter valid, learning the gyro bias: keep still"),
        (0b01011, "filter valid, learning the gyro bias, some samples rejected: keep still"),
        (0b10011, "filter valid, gyro bias not learnt, it moved"),
    ],
)
def test_status_bits_are_reported_in_words(status, words):
    t = talk(mtdata2()).run(1.0)
    deliver(t, status=status)
    assert words in t.session.status


def test_fixes_alone_are_no_stream():
    device = mtdata2()
    t = talk(device).run(2.0)
    device.settings.output = [(0x1020, 0xFFFF), (0x1060, 0xFFFF), (0x7010, 4), (0x8020, 1)]
    with pytest.raises(TransportError, match="no sample for 2 s"):
        t.run(5.0)


def deliver(t: Talk, status: int | None = None, pvt=None, mid: int = Mid.MTDATA2, data: bytes | None = None):
    """One message more, made by hand, in the session's stream."""
    t.now_ns += 5_000_000
    if data is None:
        ticks = (t.now_ns - t.session.clock_offset_ns) // 100_000
        items = [(Kind.SAMPLE_TIME_FINE, ticks)]
        items += [(Kind.STATUS_BYTE, status)] if status is not None else []
        items += [(Kind.GNSS_PVT, pvt)] if pvt is not None else []
        data = join((int(kind), write_item(kind, value)) for kind, value in items)
    return t.session.receive_data(encode(mid, data), t.now_ns)


def place_of(t: Talk, pvt):
    t.now_ns += 250_000_000
    [fix] = fixes(deliver(t, pvt=pvt))
    return fix


def test_the_other_protocol_and_malformed_messages_are_counted_and_end_the_link_when_they_stay():
    t = talk(mtdata2()).run(1.0)
    deliver(t, mid=Mid.MTDATA, data=bytes(54))
    assert t.session.counters["messages_of_the_other_protocol"] == 1
    for _ in range(MALFORMED_LIMIT):
        deliver(t, data=b"\x10\x20\x09")
    assert t.session.counters["messages_malformed"] == MALFORMED_LIMIT
    with pytest.raises(ProtocolError, match="101 malformed messages in a row: item at byte 0"):
        deliver(t, data=b"\x10\x20\x09")


def test_a_unit_that_goes_on_in_the_other_protocol_is_named_as_one():
    t = talk(mtdata2()).run(1.0)

    def go_on_in_mtdata():
        for _ in range(200):
            deliver(t, mid=Mid.MTDATA, data=bytes(54))
            t.session.tick(t.now_ns)
            t.now_ns += 10_000_000

    with pytest.raises(TransportError, match=r"came in 2 s, all of the other protocol .* another program"):
        go_on_in_mtdata()


@pytest.mark.parametrize("name", ["t1", "t2", "t3"])
def test_recordings_of_an_mti_g_710_become_samples_and_fixes(shared: Path, name):
    t = talk(mtdata2(), forward_axis="x", up_axis="-y").run(1.0)
    session = t.session
    frames = []
    for message in MessageDecoder().receive_data(
        (shared / f"captures/xsens/einride_xsens-go_{name}_output.bin").read_bytes()
    ):
        t.now_ns += 10_000_000
        frames += session.receive_data(encode(message.mid, message.data), t.now_ns)
    imu = samples(frames)
    assert len(imu) >= 94  # less what was younger than the clock's first guess
    assert len(fixes(frames)) == 4
    assert imu[-1].force_mps2[2] == pytest.approx(9.7, abs=0.3)  # it lay with -y up
    assert fixes(frames)[-1].latitude_deg == pytest.approx(57.67944, abs=1e-5)
    assert fixes(frames)[-1].altitude_m == pytest.approx(81.6, abs=0.4)
