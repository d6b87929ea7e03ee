"""The fake UTM-30LX: requests of third-party clients, the answers they need, behaviour of a real one.

The dialogues of urg_library and MRPT are replayed from recordings where those are at hand; what each client
parses is stated here from its source (urg_sensor.c, CHokuyoURG.cpp, hokuyo.py of hokuyolx).
"""

import json
from dataclasses import replace

import numpy as np
import pytest

from drivers.hokuyo_utm30lx.protocol import ReplyDecoder, decode_number, read_info
from drivers.hokuyo_utm30lx.scans import read_scan
from simulators.hokuyo_setup import Utm30lxSetup
from simulators.hokuyo_utm30lx import FakeUtm30lx
from tests.drivers.utm30lx import Room
from tests.drivers.virtual_time import sent_until

USB, ETHERNET = Utm30lxSetup(), Utm30lxSetup(wire="ethernet", serial_number="H0123456")
START_NS = 5_000 * 10**9
MS = 1_000_000


class Bench:
    """A device, a virtual clock, and the messages sent."""

    def __init__(self, setup=USB, room=None):
        self.room = room or Room()
        self.device = FakeUtm30lx(self.room, setup)
        self.now_ns = START_NS
        self.device.connected(self.now_ns)

    def send(self, text, after_ms=1.0):
        self.now_ns += round(after_ms * MS)
        return self.device.receive_data(text.encode() + b"\n", self.now_ns)

    def let(self, ms):
        """Let time pass; returns every message that left, with its time."""
        begin_ns, self.now_ns = self.now_ns, self.now_ns + round(ms * MS)
        return list(sent_until(self.device, begin_ns, self.now_ns))


def status(reply):
    return reply.split(b"\n")[1][:2].decode()


def recorded(shared, name):
    """(direction, bytes) in the order they passed."""
    for line in (shared / "captures" / "hokuyo" / name).read_text().splitlines():
        message = json.loads(line)
        yield message["dir"], bytes.fromhex(message["hex"])


@pytest.mark.parametrize("name", ["hk_urglib_get_distance.jsonl", "hk_mrpt.jsonl"])
def test_recorded_clients_get_replies_of_the_same_form_in_the_same_order(shared, name):
    """Echo, status, keys and lengths as recorded; numbers are this device's own."""
    bench = Bench(ETHERNET)
    decoder, expected, got = ReplyDecoder(), [], []
    for direction, data in recorded(shared, name):
        if direction == "host":
            got += ReplyDecoder().receive_data(bench.device.receive_data(data, bench.now_ns))
            bench.now_ns += MS
        else:
            replies = decoder.receive_data(data)
            expected += replies
            while len(got) < len(expected):  # a scan follows
                bench.now_ns = bench.device.next_due_ns(bench.now_ns)
                got += ReplyDecoder().receive_data(bench.device.due(bench.now_ns))
    assert [(r.echo, r.status, len(r.body)) for r in got if r.echo not in ("PP", "VV")] == [
        (r.echo, r.status, len(r.body)) for r in expected if r.echo not in ("PP", "VV")
    ]
    keys = [list(read_info(r)) for r in got if r.echo in ("PP", "VV")]
    assert keys == [list(read_info(r)) for r in expected if r.echo in ("PP", "VV")]


def test_a_recorded_unit_and_this_one_answer_alike(shared):
    """VV and PP byte for byte; II but for its time; the scan but for its ranges."""
    bench = Bench(replace(USB, clock_start_ms=4_821_456 - 78))
    bench.send("BM")
    expected = b"".join(data for direction, data in recorded(shared, "utm_30lx.jsonl") if direction == "dev")
    got = b""
    for direction, data in recorded(shared, "utm_30lx.jsonl"):
        if direction == "host":
            got += bench.device.receive_data(data, bench.now_ns)
            bench.now_ns += 25 * MS
    got += b"".join(data for _, data in bench.let(60.0))
    mine, theirs = (ReplyDecoder().receive_data(stream) for stream in (got, expected))
    assert [(r.echo, r.status) for r in mine] == [(r.echo, r.status) for r in theirs]
    for ours, real in zip(mine, theirs, strict=True):
        if ours.echo == "II":
            assert read_info(ours) | {"TIME": ""} == read_info(real) | {"TIME": ""}
        elif ours.status == "99":
            assert len(ours.body) == len(real.body)
        else:
            assert ours == real


def test_time_adjust_mode_is_entered_asked_and_left_as_the_specification_has_it():
    bench = Bench(replace(USB, clock_start_ms=1_000_000))
    assert status(bench.send("TM1")) == "04"
    assert status(bench.send("TM2")) == "03"
    assert [status(bench.send("TM0")) for _ in range(2)] == ["00", "02"]
    at_ns = bench.now_ns
    assert (
        decode_number(bench.send("TM1", 500.0).split(b"\n")[2][:4])
        == 1_000_000 + (at_ns - START_NS) // MS + 500
    )
    assert status(bench.send("QT")) == "0E"  # by which urg_library recognises this mode
    assert status(bench.send("PP")) == "10"
    assert status(bench.send("VV")) == "00"
    assert status(bench.send("TM2")) == "00"
    assert status(bench.send("TM7")) == "01"
    bench.send("MD0000108001000")
    assert status(bench.send("TM0")) == "10"
    assert status(Bench(ETHERNET).send("TM1")) == "00"


@pytest.mark.parametrize(
    ("command", "usb", "ethernet"),
    [
        ("XX", "0E", "0E"),
        ("SCIP2.0", "0E", "0E"),
        ("HS0", "02", "0E"),
        ("HS1", "00", "0E"),
        ("HS7", "01", "0E"),
        ("%ST", "0E", "00"),
        ("CR00", "04", "04"),
        ("CRxx", "01", "01"),
        ("SS019200", "03", "0F"),
        ("SS115200", "00", "0F"),
        ("SS123456", "02", "0F"),
        ("SSx15200", "01", "0F"),
        ("RS", "00", "00"),
        ("RT", "00", "00"),
        ("RB", "01", "01"),
        ("DB09", "01", "01"),
        ("DB10", "00", "00"),
        ("GD0000108001", "10", "10"),
        ("MD0000", "0C", "0H"),
        ("MDx000108001000", "01", "01"),
        ("MD0000x08001000", "02", "02"),
        ("MD00001080x1000", "03", "03"),
        ("MD000010800100", "0C", "0H"),
        ("MD0000108101000", "04", "04"),
        ("MD0500040001000", "05", "05"),
        ("MD0000108001x00", "06", "06"),
        ("MD00001080010xx", "07", "07"),
        ("ND0000108001000", "0E", "00"),
        ("HE0000108001", "0E", "10"),
        ("QT;1234567890123456", "00", "00"),
        ("QT;12345678901234567", "0G", "0G"),
        ("QTabc", "00", "0D"),
    ],
)
def test_statuses_of_commands_in_standby(command, usb, ethernet):
    for setup, expected in ((USB, usb), (ETHERNET, ethernet)):
        reply = Bench(setup).send(command)
        assert reply.split(b"\n")[0].decode() == command
        assert status(reply) == expected
        assert reply.endswith(b"\n\n")


def test_stream_runs_at_40_hz_and_a_scan_leaves_when_its_sweep_is_over():
    bench = Bench(replace(USB, motor_speed=25.0 / 25.05, clock_start_ms=2**24 - 500, clock_drift_ppm=100.0))
    bench.send("MD0000108001000")
    out = bench.let(1_000.0)
    left_ns = np.array([at_ns for at_ns, _ in out])
    first_rays_ns = np.array(bench.room.first_rays_ns)
    assert len(out) == 39
    np.testing.assert_allclose(np.diff(left_ns), 25_050_000, atol=2)
    np.testing.assert_allclose(left_ns - first_rays_ns, 0.75 * 25_050_000 + 300_000, atol=2)
    stamps_ms = [read_scan(ReplyDecoder().receive_data(message)[0]).stamp_ms for _, message in out]
    since_ms = (first_rays_ns - START_NS) / MS * (1 + 100e-6)
    assert stamps_ms == [(2**24 - 500 + int(ms)) % 2**24 for ms in since_ms]


def test_what_cannot_be_measured_has_a_code():
    class Odd:
        def sweep(self, beams):
            return replace(Room().sweep(beams), range_m=np.array([np.nan, 0.01, 70.0, 5.0] * 100, np.float32))

    for setup, none in ((USB, 1), (replace(ETHERNET, no_return_mm=65_533), 65_533)):
        bench = Bench(setup, Odd())
        bench.send("MD0000039901000")
        scan = read_scan(ReplyDecoder().receive_data(bench.let(60.0)[0][1])[0])
        assert scan.distance_mm[0, :4].tolist() == [none, 4, none, 5000]


def test_usb_streams_on_without_a_client_and_ethernet_stops():
    for setup, goes_on in ((USB, True), (ETHERNET, False)):
        bench = Bench(setup)
        bench.send("MD0000108001000")
        bench.let(100.0)
        bench.device.disconnected(bench.now_ns)
        bench.now_ns += 10_000 * MS
        tail = bench.device.connected(bench.now_ns)
        assert bool(tail) == goes_on
        assert not tail.startswith(b"MD")  # connected within a scan
        out = bench.let(100.0)
        assert bool(out) == goes_on
        if goes_on:
            scan = read_scan(ReplyDecoder().receive_data(out[0][1])[0])
            assert scan.stamp_ms == pytest.approx((out[0][0] - START_NS) / MS - 19, abs=1)
