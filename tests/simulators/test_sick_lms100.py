"""The fake LMS100: requests of third-party clients, the answers they need, behaviour of a real one.

The dialogues are replayed from recordings of libLMS1xx, MRPT and sick_scan_xd where those are at hand; what
each client parses is stated here from its source (LMS1xx.cpp, CLMS100eth.cpp, sick_scan_common.cpp).
"""

import ast

import numpy as np
import pytest

from drivers.sick_lms100.protocol import Decoder, Dialect, Telegram, encode, reader
from drivers.sick_lms100.telegrams import read_scan
from simulators.sick_lms100 import FakeLms100
from simulators.sick_setup import Lms100Setup
from tests.drivers.lms100 import Room
from tests.drivers.virtual_time import sent_until

ASCII, BINARY = Dialect.ASCII, Dialect.BINARY
START_NS = 5_000 * 10**9
MS = 1_000_000
LOGIN = b"\x02sMN SetAccessMode 03 F4724744\x03"


class Bench:
    """A device, a virtual clock, and the messages sent."""

    def __init__(self, setup=None):
        self.room = Room()
        self.device = FakeLms100(self.room, setup or Lms100Setup())
        self.now_ns = START_NS
        self.device.connected(self.now_ns)

    def send(self, data):
        self.now_ns += MS
        return self.device.receive_data(data, self.now_ns)

    def let(self, ms):
        """Let time pass; returns every message that left, with its time."""
        begin_ns, self.now_ns = self.now_ns, self.now_ns + round(ms * MS)
        return [one for one in sent_until(self.device, begin_ns, self.now_ns) if one[1]]


def dialogue(path):
    """The requests in one recorded dialogue: a list of sessions, each a list of framed requests."""
    sessions = []
    for line in path.read_text().splitlines():
        if line == "ACCEPT":
            sessions.append([])
        elif line[:1].isdigit():
            _, letter, payload = line.split(" ", 2)
            payload = ast.literal_eval(payload)
            if letter == "A":
                sessions[-1].append(b"\x02" + payload + b"\x03")
            else:
                checksum = int(np.bitwise_xor.reduce(np.frombuffer(payload, np.uint8)))
                sessions[-1].append(
                    b"\x02\x02\x02\x02" + len(payload).to_bytes(4, "big") + payload + bytes([checksum])
                )
    return sessions


KINDS = {"sRN": "sRA", "sWN": "sWA", "sMN": "sAN", "sEN": "sEA"}


def test_liblms1xx_and_mrpt_get_through_their_start_up(shared):
    lib, mrpt = dialogue(shared / "captures/sick/client_dialogue_libLMS1xx_then_MRPT_colaA.txt")
    bench = Bench()
    answers = {}
    for request in lib:
        answer = bench.send(request)
        assert answer.startswith(b"\x02")
        assert answer.count(b"\x03") == 1
        assert answer.endswith(b"\x03")
        [requested], [answered] = Decoder().receive_data(request), Decoder().receive_data(answer)
        assert (answered.kind, answered.name) == (KINDS[requested.kind], requested.name)
        answers[requested.name] = answer
        if requested.name == "LMCstartmeas":
            bench.let(1000)
        elif request.endswith(b"LMDscandata 1\x03"):
            messages = bench.let(200)
            scan = messages[0][1]
            assert scan.startswith(b"\x02")
            assert scan.endswith(b"\x03")
            tokens = scan[1:-1].split(b" ")
            # libLMS1xx: status, inputs and outputs are two tokens each, then encoders and channels.
            assert tokens[18:21] == [b"0", b"2", b"DIST1"]
            assert tokens[25] == b"21D"
    assert answers["SetAccessMode"] == b"\x02sAN SetAccessMode 1\x03"
    assert answers["LMPscancfg"] == b"\x02sRA LMPscancfg 1388 1 1388 FFF92230 225510\x03"
    assert answers["mLMPsetscancfg"] == b"\x02sAN mLMPsetscancfg 0 1388 1 1388 FFF92230 225510\x03"
    assert answers["STlms"][10:12] == b" 7"  # both clients look at this byte
    bench.device.disconnected(bench.now_ns)
    bench.device.connected(bench.now_ns)
    for request in mrpt[:-5]:
        assert Decoder().receive_data(bench.send(request))[0].kind != "sFA"
        bench.let(1000)
    bench.let(1000)
    for request in mrpt[-5:]:
        tokens = bench.send(request)[1:-1].split(b" ")
        assert tokens[:2] == [b"sRA", b"LMDscandata"]
        assert (tokens[20], int(tokens[25], 16)) == (b"DIST1", 1081)
        assert len(tokens) > 26 + 1081
        bench.let(140)


def test_output_state_has_the_layout_and_length_of_an_lms1xx():
    bench = Bench(Lms100Setup(dialect=BINARY))
    for name in ("LIDoutputstate", "LMDscandata"):
        bench.send(encode(Telegram(BINARY, "sEN", name, b"\1")))
    messages = [m for _, m in bench.let(500)]
    [event] = [m for m in messages if b"LIDoutputstate" in m]
    assert len(event) == 93 + 9
    [telegram] = Decoder().receive_data(event)
    r = reader(telegram)
    assert r.u16() == 1
    r.u32()
    states = [(r.u8(), r.u32()) for _ in range(11)]
    assert [state for state, _ in states] == [0, 0, 1] + [2] * 8
    assert messages.index(event) == 7  # between scans, when the error flag goes


@pytest.mark.parametrize(
    ("request_text", "code"),
    [
        ("sWN LMPoutputRange 1 1388 0 1B7740", "A"),
        ("sMN LMCstartmeas", "1"),
        ("sRN NoSuchThing", "3"),
        ("sRN field030", "3"),
        ("sWN FREchoFilter 0", "3"),
        ("sMN NoSuchThing", "2"),
        ("sEN NoSuchThing 1", "F"),
        ("sEN LMDscandata", "8"),
        ("sXN What", "C"),
    ],
)
def test_what_is_not_allowed_is_refused_with_the_right_code(request_text, code):
    assert Bench().send(b"\x02" + request_text.encode() + b"\x03") == b"\x02sFA " + code.encode() + b"\x03"


@pytest.mark.parametrize("dialect", [ASCII, BINARY])
def test_other_dialect_gets_no_answer(dialect):
    other = BINARY if dialect is ASCII else ASCII
    bench = Bench(Lms100Setup(dialect=dialect))
    assert bench.send(encode(Telegram(other, "sRN", "SCdevicestate"))) == b""
    assert bench.send(encode(Telegram(dialect, "sRN", "SCdevicestate"))) != b""
    assert bench.device.counters["requests_in_other_dialect"] == 1


def test_login_is_checked_and_ends_with_run_and_with_the_connection():
    bench = Bench()
    write = b"\x02sWN LMDscandatacfg 01 00 0 0 0 00 00 0 0 0 1 +1\x03"
    assert bench.send(b"\x02sMN SetAccessMode 3 12345678\x03") == b"\x02sAN SetAccessMode 0\x03"
    assert bench.send(write) == b"\x02sFA A\x03"
    assert bench.send(LOGIN) == b"\x02sAN SetAccessMode 1\x03"
    assert bench.send(write) == b"\x02sWA LMDscandatacfg\x03"
    bench.send(b"\x02sMN Run\x03")
    assert bench.send(write) == b"\x02sFA A\x03"
    bench.send(LOGIN)
    bench.device.disconnected(bench.now_ns)
    bench.device.connected(bench.now_ns)
    assert bench.send(write) == b"\x02sFA A\x03"


def test_scan_leaves_after_its_last_ray_and_its_stamps_are_a_real_ones():
    bench, decoder = Bench(Lms100Setup(clock_drift_ppm=100.0)), Decoder()
    assert bench.send(encode(Telegram(ASCII, "sEN", "LMDscandata", b"1")))
    telegrams = [(at_ns, t) for at_ns, message in bench.let(20_000) for t in decoder.receive_data(message)]
    scans = [(at_ns, read_scan(t)) for at_ns, t in telegrams if t.name == "LMDscandata"]
    first_rays_ns = np.array(bench.room.first_rays_ns)
    assert len(scans) == len(first_rays_ns)
    in_flight_ms = (np.array([at_ns for at_ns, _ in scans]) - first_rays_ns) / MS
    assert 15.0 < in_flight_ms.min() <= in_flight_ms.max() < 15.6  # 270 deg at 49.8 Hz
    start_us = np.array([scan.start_us for _, scan in scans])
    after_us = np.array([scan.sent_us for _, scan in scans]) - start_us
    assert 3_000 < after_us.min() < after_us.max() < 3_300
    step_ms = np.diff(start_us) / 1e3
    assert 20.07 < step_ms.min() <= step_ms.max() < 20.18
    assert np.mean(step_ms / (np.diff(first_rays_ns) / MS)) == pytest.approx(1 + 100e-6, abs=5e-6)
