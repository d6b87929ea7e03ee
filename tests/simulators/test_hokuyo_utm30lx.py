"""The pretended UTM-30LX: what third-party clients ask, what they need for an answer, a real one's habits.

The dialogues of urg_library and MRPT are replayed from recordings where those are at hand; what each client
parses is stated here from its source (urg_sensor.c, CHokuyoURG.cpp, hokuyo.py of hokuyolx).
"""

import json
import threading
from contextlib import ExitStack
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from drivers.hokuyo_utm30lx.driver import HokuyoUtm30lxSession
from drivers.hokuyo_utm30lx.port import open_port
from drivers.hokuyo_utm30lx.protocol import ReplyDecoder, checksum, decode_number, read_info
from drivers.hokuyo_utm30lx.scans import read_scan
from drivers.link import LinkHealth, run_link
from simulators.hokuyo_setup import Utm30lxSetup
from simulators.hokuyo_utm30lx import FakeUtm30lx
from simulators.wire import serve_pty, serve_tcp
from tests.drivers.utm30lx import Room, config
from tests.in_background import in_background

USB, ETHERNET = Utm30lxSetup(), Utm30lxSetup(wire="ethernet", serial_number="H0123456")
START_NS = 5_000 * 10**9
MS = 1_000_000


class Bench:
    """A device, a clock that is moved by hand, and what came out."""

    def __init__(self, setup=USB, room=None):
        self.room = room or Room()
        self.device = FakeUtm30lx(self.room, setup)
        self.now_ns = START_NS
        self.device.connected(self.now_ns)

    def say(self, text, after_ms=1.0):
        self.now_ns += round(after_ms * MS)
        return self.device.receive_data(text.encode() + b"\n", self.now_ns)

    def let(self, ms):
        """Let time pass; returns every message that left, with its time."""
        end_ns, out = self.now_ns + round(ms * MS), []
        while (due_ns := self.device.next_due_ns(self.now_ns)) is not None and due_ns <= end_ns:
            self.now_ns = max(self.now_ns, due_ns)
            out.append((self.now_ns, self.device.due(self.now_ns)))
        self.now_ns = end_ns
        return out


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
    """VV and PP byte for byte; II but for its time; the scan but for what it sees."""
    bench = Bench(replace(USB, clock_start_ms=4_821_456 - 78))
    bench.say("BM")
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
    assert status(bench.say("TM1")) == "04"
    assert status(bench.say("TM2")) == "03"
    assert [status(bench.say("TM0")) for _ in range(2)] == ["00", "02"]
    at_ns = bench.now_ns
    assert (
        decode_number(bench.say("TM1", 500.0).split(b"\n")[2][:4])
        == 1_000_000 + (at_ns - START_NS) // MS + 500
    )
    assert status(bench.say("QT")) == "0E"  # by which urg_library knows this mode
    assert status(bench.say("PP")) == "10"
    assert status(bench.say("VV")) == "00"
    assert status(bench.say("TM2")) == "00"
    assert status(bench.say("TM7")) == "01"
    bench.say("MD0000108001000")
    assert status(bench.say("TM0")) == "10"
    assert status(Bench(ETHERNET).say("TM1")) == "00"


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
        reply = Bench(setup).say(command)
        assert reply.split(b"\n")[0].decode() == command
        assert status(reply) == expected
        assert reply.endswith(b"\n\n")


def test_laser_on_twice_and_off():
    bench = Bench()
    assert [status(bench.say("BM")) for _ in range(2)] == ["00", "02"]
    assert b"LASR:ON" in bench.say("II")
    assert status(bench.say("QT")) == "00"
    assert b"LASR:OFF" in bench.say("II")
    bench.device.laser_broken = True
    assert status(bench.say("BM")) == "01"
    assert status(bench.say("MD0000108001000")) == "50"


def test_single_scan_leaves_after_the_next_sweep_and_its_status_is_00():
    bench = Bench()
    bench.say("BM")
    assert bench.say("GE0100020002") == b""
    ((left_ns, message),) = bench.let(100.0)
    (reply,) = ReplyDecoder().receive_data(message)
    assert (reply.echo, reply.status) == ("GE0100020002", "00")
    assert read_scan(reply).distance_mm.shape == (1, 51)
    first_ray_ns, interval_ns, first_rad, _, beams = bench.room.requested[0]
    assert beams == 101
    assert first_rad == pytest.approx(np.radians((100 - 540) * 0.25))
    assert left_ns == pytest.approx(first_ray_ns + 100 * interval_ns + 300_000, abs=1_000)


def test_counted_stream_counts_down_and_puts_the_laser_out():
    bench = Bench()
    assert bench.say("MD0000108001003;x1") == b"MD0000108001003;x1\n00P\n\n"
    replies = [ReplyDecoder().receive_data(message)[0] for _, message in bench.let(300.0)]
    assert [r.echo for r in replies] == [f"MD000010800100{n};x1" for n in (2, 1, 0)]
    assert b"LASR:OFF" in bench.say("II")


def test_stream_runs_at_40_hz_and_a_scan_leaves_when_its_sweep_is_over():
    bench = Bench(replace(USB, motor_speed=25.0 / 25.05, clock_start_ms=2**24 - 500, clock_drift_ppm=100.0))
    bench.say("MD0000108001000")
    out = bench.let(1_000.0)
    left_ns = np.array([at_ns for at_ns, _ in out])
    first_rays_ns = np.array(bench.room.first_rays_ns)
    assert len(out) == 39
    np.testing.assert_allclose(np.diff(left_ns), 25_050_000, atol=2)
    np.testing.assert_allclose(left_ns - first_rays_ns, 0.75 * 25_050_000 + 300_000, atol=2)
    stamps_ms = [read_scan(ReplyDecoder().receive_data(message)[0]).stamp_ms for _, message in out]
    since_ms = (first_rays_ns - START_NS) / MS * (1 + 100e-6)
    assert stamps_ms == [(2**24 - 500 + int(ms)) % 2**24 for ms in since_ms]


def test_skip_leaves_scans_out_and_cluster_takes_the_nearest():
    bench = Bench()
    bench.say("MD0000108004300")
    out = bench.let(1_000.0)
    assert np.diff([at_ns for at_ns, _ in out]) == pytest.approx(100_000_000, abs=2)
    scan = read_scan(ReplyDecoder().receive_data(out[0][1])[0])
    assert scan.distance_mm[0, :4].tolist() == [1001, 1004, 1008, 1012]  # 0 and 10, 20 are without echo


def test_short_values_saturate_at_4095():
    bench = Bench()
    bench.say("BM")
    bench.say("GS0000108001")
    scan = read_scan(ReplyDecoder().receive_data(bench.let(60.0)[0][1])[0])
    assert scan.distance_mm.max() == 2079
    bench.room.sweep = lambda *requested: replace(
        Room().sweep(*requested), range_m=np.full(1081, 20.0, np.float32)
    )
    bench.say("GS0000108001")
    assert read_scan(ReplyDecoder().receive_data(bench.let(60.0)[0][1])[0]).distance_mm.min() == 4095


def test_ethernet_unit_sees_behind_things_where_it_can():
    bench = Bench(replace(ETHERNET, further_echo_share=0.3))
    bench.say("NE0000108001000")
    scan = read_scan(ReplyDecoder().receive_data(bench.let(60.0)[0][1])[0])
    assert scan.distance_mm.shape == (3, 1081)
    second = scan.distance_mm[1] >= 0
    assert 200 < second.sum() < 400
    assert (scan.distance_mm[1] > scan.distance_mm[0])[second].all()
    assert (scan.intensity[1] < scan.intensity[0])[second].all()
    assert (scan.distance_mm[0][second] >= 23).all()


def test_what_cannot_be_measured_has_a_code():
    class Odd:
        def sweep(self, *requested):
            return replace(
                Room().sweep(*requested), range_m=np.array([np.nan, 0.01, 70.0, 5.0] * 100, np.float32)
            )

    for setup, none in ((USB, 1), (replace(ETHERNET, no_return_mm=65_533), 65_533)):
        bench = Bench(setup, Odd())
        bench.say("MD0000039901000")
        scan = read_scan(ReplyDecoder().receive_data(bench.let(60.0)[0][1])[0])
        assert scan.distance_mm[0, :4].tolist() == [none, 4, none, 5000]


def test_same_stream_again_overrides_and_another_kind_is_denied():
    bench = Bench()
    bench.say("MD0000108001000")
    assert status(bench.say("ME0000108001000")) == "10"
    assert status(bench.say("MD0540054101900")) == "00"
    assert len(ReplyDecoder().receive_data(bench.let(60.0)[0][1])[0].body) < 30


def test_booting_is_silent_and_warming_up_is_unstable():
    bench = Bench(replace(USB, boot_ns=1_500 * MS, warm_up_ns=1_000 * MS))
    assert bench.say("VV", 1_400.0) == b""
    assert status(bench.say("VV", 200.0)) == "00"
    assert [status(bench.say(text)) for text in ("BM", "MD0000108001000")] == ["0M", "0M"]
    assert status(bench.say("BM", 1_000.0)) == "00"


def test_abnormal_device_refuses_all_but_who_it_is_and_a_reboot():
    bench = Bench(replace(USB, boot_ns=500 * MS))
    bench.now_ns += 600 * MS
    bench.device.abnormal = True
    assert [status(bench.say(text)) for text in ("QT", "BM", "RS", "MD0000108001000", "TM0")] == ["0L"] * 5
    assert b"Trouble!! Error No. =[00->33]" in bench.say("II")
    assert status(bench.say("VV")) == "00"
    assert status(bench.say("RB")) == "01"
    assert status(bench.say("RB", 1_100.0)) == "01"  # more than a second later it is a first one again
    assert status(bench.say("RB", 500.0)) == "00"
    assert bench.say("QT") == b""
    assert status(bench.say("QT", 600.0)) == "00"


def test_power_cut_costs_stream_and_clock_and_a_command_half_heard():
    bench = Bench(replace(USB, boot_ns=1_000 * MS))
    bench.now_ns += 60_000 * MS
    bench.say("MD0000108001000")
    bench.device.receive_data(b"MD00001", bench.now_ns)
    bench.device.restart(bench.now_ns)
    assert bench.let(2000.0) == []
    assert int(read_info(ReplyDecoder().receive_data(bench.say("II"))[0])["TIME"], 16) == 2001


@pytest.mark.parametrize("seconds", [30.0, -1.5])
def test_clock_that_jumps_shows(seconds):
    bench = Bench(replace(USB, clock_start_ms=5_000_000))
    bench.device.jump_clock(seconds)
    reported_ms = int(read_info(ReplyDecoder().receive_data(bench.say("II"))[0])["TIME"], 16)
    assert reported_ms == 5_000_001 + seconds * 1000


def test_spoilt_checksum_costs_one_line_and_an_echo_has_none():
    bench = Bench()
    bench.say("MD0000108001000")
    (_, message), *_ = bench.let(100.0)
    spoilt = bench.device.spoil_checksum(message)
    assert len(spoilt) == len(message)
    line = spoilt.splitlines()[-2]
    assert line[-1] != checksum(line[:-1])
    assert spoilt[:-3] == message[:-3]
    assert bench.device.spoil_checksum(b"MD\n") == b"MD\n"


def test_states_of_an_ethernet_unit():
    bench = Bench(ETHERNET)

    def state():
        return bench.say("%ST").split(b"\n")[2][:3]

    seen = [state()]
    for command in ("BM", "MD0000108001000", "QT", "%SL", "BM", "QT", "TM0"):
        bench.say(command)
        seen.append(state())
    assert seen == [b"000", b"003", b"004", b"000", b"005", b"003", b"000", b"002"]


def test_scip_1_refuses_all_until_it_is_reported():
    bench = Bench(replace(USB, scip_1=True))
    assert bench.say("QT") == b"QT\nE\n\n"
    assert bench.say("SCIP2.0") == b"SCIP2.0\n0\n\n"
    assert bench.say("QT") == b"QT\n00P\n\n"


def test_usb_streams_on_for_no_one_and_ethernet_stops():
    for setup, goes_on in ((USB, True), (ETHERNET, False)):
        bench = Bench(setup)
        bench.say("MD0000108001000")
        bench.let(100.0)
        bench.device.disconnected(bench.now_ns)
        bench.now_ns += 10_000 * MS
        tail = bench.device.connected(bench.now_ns)
        assert bool(tail) == goes_on
        assert not tail.startswith(b"MD")  # we come in the middle of a scan
        out = bench.let(100.0)
        assert bool(out) == goes_on
        if goes_on:
            scan = read_scan(ReplyDecoder().receive_data(out[0][1])[0])
            assert scan.stamp_ms == pytest.approx((out[0][0] - START_NS) / MS - 19, abs=1)


def test_a_hardware_fault_stops_the_stream_with_its_status_and_98_goes_on():
    bench = Bench()
    bench.say("MD0000108001000")
    bench.let(100.0)
    bench.device.fault_status = "21"
    assert [status(message) for _, message in bench.let(200.0)] == ["21"]
    bench.device.fault_status = ""
    assert [status(message) for _, message in bench.let(60.0)][:2] == ["98", "99"]
    bench.device.fault_status = "50"
    assert [status(message) for _, message in bench.let(200.0)] == ["50"]
    assert bench.device.abnormal


@pytest.fixture
def linked():
    """Runs drivers.link against a fake device on a real wire, and always stops it."""

    def run(cfg, wanted):
        health, frames, enough = LinkHealth("rear"), [], threading.Condition()

        def sink(frame):
            with enough:
                frames.append(frame)
                enough.notify_all()

        ends = lambda: open_port(cfg), lambda: HokuyoUtm30lxSession(cfg)
        stopped.enter_context(in_background(partial(run_link, health, *ends, sink)))

        def wait_for(count, timeout_s=60.0):
            with enough:
                assert enough.wait_for(lambda: len(frames) >= count, timeout_s), health
            return frames

        wait_for(wanted)
        return health, wait_for

    with ExitStack() as stopped:
        yield run


def test_driver_reads_from_a_usb_unit_over_a_terminal_again_after_it_was_unplugged(linked, tmp_path):
    device = FakeUtm30lx(Room(), USB)
    wire = serve_pty(device, tmp_path / "utm")
    with wire as path:
        health, wait_for = linked(config(device=path, serial_number="00903971"), 40)
        wire.cut()  # power and all: it comes back streaming for the dead connection
        wire.restore()
        frames = wait_for(len(wait_for(1)) + 40)
        assert health.connects >= 2
        assert health.counters["scans_malformed"] == 0
        assert np.nanmax(frames[-1].range_m) == np.float32(2.079)


def test_driver_reads_from_an_ethernet_unit_over_tcp_again_after_a_power_cut(linked):
    device = FakeUtm30lx(Room(), replace(ETHERNET, no_return_mm=65_533))
    wire = serve_tcp(device)
    with wire as (host, port):
        health, wait_for = linked(config(host=host, port=port, echo="strongest"), 20)
        wire.cut()
        device.power_on(device.next_due_ns(0) or 0)
        wire.restore()
        wait_for(len(wait_for(1)) + 20)
        assert health.connects >= 2
