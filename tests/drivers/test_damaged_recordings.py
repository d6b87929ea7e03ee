"""What real devices said, damaged in every way, poured over the sessions: some thousand times in each run of
the tests, a million times in the soak. Every other message is damaged before its checksum is made, so that
its content is read. Sessions are in all states of their dialogue, and made again where they end, as the link
does.

The MTi-G has such a test of its own in test_xsens_mtig_driver.py.
"""

import json
import logging
import random
import resource
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from drivers.errors import DeviceError, ProtocolError, TransportError
from drivers.hokuyo_utm30lx.protocol import MAX_REPLY_BYTES, REPLY_END, ReplyDecoder, checksum
from drivers.hokuyo_utm30lx.scans import Scan, ScanRequest, read_scan, write_scan
from drivers.ibeo_lux import protocol as lux_protocol
from drivers.ibeo_lux.messages import ErrorRegisters
from drivers.irobot_create.create1 import QUERY_IDS
from drivers.irobot_create.driver import STREAM_IDS
from drivers.irobot_create.protocol import FRAME_PERIOD_NS, PacketId, encode_frame, encode_values
from drivers.sick_lms100.protocol import HEADER, MAX_TELEGRAM_BYTES, Decoder, Dialect, encode
from drivers.sick_lms100.telegrams import read_scan as read_sick_scan
from drivers.sick_lms100.telegrams import write_scan as write_sick_scan
from tests.drivers.damage import mutate, waiting
from tests.drivers.faulty_devices import BENCHES
from tests.drivers.virtual_time import Talk

MILLION = 1_000_000
A_FEW = 2_000
WHOLE_EVERY = 8  # messages; nothing but damage ends a session too soon
CHECK_EVERY = 500  # messages
FLUSHES = 4  # good messages after which one has been read, whatever came before
SLOWEST_S = 0.25  # of a thread's own time, for one message: nothing hangs
GROWTH_MB = 40
PATIENCE_S = 60  # a new LMS100 session waits 45 s for its first scan
MAX_COUNTERS = 120  # names, which garbage must not invent; a LUX has one for each bit of four registers
STARTED_FOR_S = (0.0, 0.06, 0.3, 1.0, 3.0)  # how long a session has talked with a real one before


@dataclass(frozen=True)
class Recorded:
    """What is poured, and over whom.

    bench       of the device, in BENCHES
    wires       as recorded; `good` is one of them that the session reads as a measurement
    whole       content -> message with a checksum that fits; `contents` belong to it
    held        how many bytes the session keeps for later
    most        of those
    read        by the session's counters, how many measurements were decoded; none: it only answers questions
    raises      what receive_data may raise
    between_ns  from one message to the next: silence is not what is tried here
    """

    bench: str
    wires: Sequence[bytes]
    good: bytes
    contents: Sequence[bytes]
    whole: Callable[[bytes], bytes]
    held: Callable[[Any], int]
    most: int
    read: tuple[str, ...]
    raises: tuple[type[Exception], ...] = (ProtocolError, DeviceError)  # an answer may be a refusal
    between_ns: int = 1_000_000


@dataclass
class Figures:
    sessions: int = 0
    ended: Counter[str] = field(default_factory=Counter)
    counters: Counter[str] = field(default_factory=Counter)
    slowest_s: float = 0.0
    most_held: int = 0
    grown_mb: float = 0.0


def _sick(shared: Path, dialect: Dialect) -> Recorded:
    rows = map(json.loads, (shared / "captures/sick/20210302_lms111.jsonl").read_text().splitlines())
    said = [bytes.fromhex(row["hex"]) for row in rows if row["dir"] == "dev"]
    scans = [wire for wire in said if b"sSN LMDscandata" in wire]
    others = [wire for wire in said if b"sSN LMDscandata" not in wire]
    wires = others + scans[: len(others)]
    if dialect is Dialect.ASCII:
        decoded = [Decoder().receive_data(wire)[0] for wire in scans[:20]]
        scans = [encode(write_sick_scan(read_sick_scan(telegram), dialect)) for telegram in decoded]
        wires = [
            *scans,
            b"\x02sEA LMDscandata 1\x03",
            b"\x02sFA 4\x03",
            b"\x02sRA STlms 7 0 8 00:00:04 8\x03",
        ]
    framing = 1 if dialect is Dialect.ASCII else 8
    return Recorded(
        "lms100 cola_a" if dialect is Dialect.ASCII else "lms100 cola_b",
        wires,
        scans[0],
        [wire[framing:-1] for wire in wires],
        _whole_ascii if dialect is Dialect.ASCII else _whole_binary,
        waiting,
        MAX_TELEGRAM_BYTES + 9,
        ("scans_received",),
    )


def _whole_ascii(content: bytes) -> bytes:
    return b"\x02" + content + b"\x03"


def _whole_binary(content: bytes) -> bytes:
    total = 0
    for byte in content:
        total ^= byte
    return HEADER + len(content).to_bytes(4, "big") + content + bytes([total])


def _utm30lx(shared: Path) -> Recorded:
    wires: list[bytes] = []
    for name in ("utm_30lx.jsonl", "hk_mrpt.jsonl"):
        rows = map(json.loads, (shared / "captures/hokuyo" / name).read_text().splitlines())
        said = b"".join(bytes.fromhex(row["hex"]) for row in rows if row["dir"] == "dev")
        wires += {part + REPLY_END for part in said.split(REPLY_END) if part}
    wires.sort()
    [real] = [
        read_scan(reply)
        for reply in ReplyDecoder().receive_data(b"".join(wires))
        if reply.echo.startswith("ME") and reply.status == "99"
    ]
    asked = ScanRequest("MD", 0, 1080)
    good = write_scan(Scan(asked, real.stamp_ms, real.distance_mm, real.intensity[:0]), asked.text, "99")
    wires += [good] * len(wires)
    return Recorded(
        "utm30lx usb",
        wires,
        good,
        [_without_sums(wire) for wire in wires],
        _with_sums,
        waiting,
        MAX_REPLY_BYTES,
        ("scans_received", "scans_of_old_stream"),
        raises=(ProtocolError, DeviceError, TransportError),  # a status tells a fault, or the stream's end
    )


def _without_sums(wire: bytes) -> bytes:
    echo, _, rest = wire.removesuffix(REPLY_END).partition(b"\n")
    return b"\n".join([echo, *(line[:-1] for line in rest.split(b"\n"))])


def _with_sums(content: bytes) -> bytes:
    echo, _, rest = content.partition(b"\n")
    return b"\n".join([echo, *(line + bytes([checksum(line)]) for line in rest.split(b"\n"))]) + REPLY_END


def _lux(shared: Path) -> Recorded:
    payload = (shared / "captures/ibeo/ldmrs_scan_payload_0x2202.bin").read_bytes()
    started = bytes.fromhex("2000") + bytes(12)
    messages = [
        *[lux_protocol.Message(lux_protocol.DataType.SCAN, payload, 7)] * 3,
        lux_protocol.Message(lux_protocol.DataType.ERRORS, ErrorRegisters(errors_1=2).write(), 7),
        lux_protocol.Message(lux_protocol.DataType.REPLY, started, 7),
        lux_protocol.Message(lux_protocol.DataType.OBJECTS, bytes(20), 7),
    ]
    wires = [lux_protocol.encode(message) for message in messages]
    return Recorded(
        "lux",
        wires,
        wires[0],
        wires,
        _whole_lux,
        waiting,
        lux_protocol.MAX_MESSAGE_BYTES + 2 * len(wires[0]),
        ("scans_received",),
        raises=(ProtocolError, DeviceError, TransportError),  # scans of a device that was reset
    )


def _whole_lux(content: bytes) -> bytes:
    """It has no checksum; the size in its header is made to fit."""
    header, payload = content[: lux_protocol.HEADER_BYTES], content[lux_protocol.HEADER_BYTES :]
    return header[:8] + len(payload).to_bytes(4, "big") + header[12:] + payload


def _roomba_values(shared: Path) -> dict[int, int]:
    seen = json.loads((shared / "captures/irobot/roomba690_sensor_snapshot.json").read_text())
    return {
        PacketId.VOLTAGE: seen["voltage_mV"],
        PacketId.CURRENT: seen["current_mA"],
        PacketId.TEMPERATURE: seen["temperature_C"],
        PacketId.BATTERY_CHARGE: seen["charge_mAh"],
        PacketId.BATTERY_CAPACITY: seen["capacity_mAh"],
        PacketId.LEFT_ENCODER: seen["encoder_left"],
        PacketId.RIGHT_ENCODER: seen["encoder_right"],
        PacketId.OI_MODE: seen["oi_mode_raw"]["passive"],
    }


def _create(shared: Path, model: str) -> Recorded:
    values = _roomba_values(shared)
    said = [path.read_bytes() for path in sorted((shared / "captures/irobot").glob("*.bin"))]
    asked = model == "create1"
    good = encode_values(QUERY_IDS, values) if asked else encode_frame(STREAM_IDS, values)
    return Recorded(
        model,
        [*said, *[good] * 200],  # seldom a banner: after one there is no stream for a while
        good,
        [good] if asked else [good[2:-1]],
        (lambda content: content) if asked else _whole_frame,
        lambda session: len(session._answer) if asked else waiting(session),
        len(good),
        () if asked else ("frames_received", "frames_of_old_stream"),
        between_ns=100_000_000 if asked else FRAME_PERIOD_NS,  # else one hears no answer, the other no stream
    )


def _whole_frame(content: bytes) -> bytes:
    frame = bytes([19, len(content) & 0xFF]) + content
    return frame + bytes([-sum(frame) & 0xFF])


CASES: dict[str, Callable[[Path], Recorded]] = {
    "lms100 cola_a": lambda shared: _sick(shared, Dialect.ASCII),
    "lms100 cola_b": lambda shared: _sick(shared, Dialect.BINARY),
    "utm30lx": _utm30lx,
    "lux": _lux,
    "create2": lambda shared: _create(shared, "create2"),
    "create1": lambda shared: _create(shared, "create1"),
}


def _begin(bench: str, chance: random.Random) -> Talk:
    """A device and a session somewhere in its start, or streaming."""
    made = Talk(None, BENCHES[bench].device())  # type: ignore[arg-type]
    made.session = BENCHES[bench].sessions(lambda: made.now_ns)()
    return made.connect().run(chance.choice(STARTED_FOR_S))


def pour(recorded: Recorded, count: int, seed: int) -> Figures:
    """Damage `count` messages. Whatever is not allowed is raised."""
    chance, figures = random.Random(seed), Figures(sessions=1)
    before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    talk = _begin(recorded.bench, chance)
    for i in range(count):
        talk.now_ns += recorded.between_ns
        if i % WHOLE_EVERY == 0:
            talk = _hear(talk, recorded, figures, chance.choice(recorded.wires), chance)
        if i % 2:
            wire = recorded.whole(mutate(chance.choice(recorded.contents), chance))
        else:
            wire = mutate(chance.choice(recorded.wires), chance)
        try:
            talk.session.tick(talk.now_ns)
        except (TransportError, DeviceError) as error:
            talk = _anew(talk, recorded, figures, f"tick: {type(error).__name__}", chance)
        talk.session.outbox.clear()
        talk = _hear(talk, recorded, figures, wire, chance)
        if i % CHECK_EVERY == 0 and recorded.read:
            talk = _check_that_a_good_one_is_read(talk, recorded, figures, chance)
    _check_that_frames_come(talk, recorded, figures)
    assert figures.most_held <= recorded.most
    assert figures.slowest_s < SLOWEST_S
    figures.grown_mb = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kb) / 1024
    assert len(figures.counters) < MAX_COUNTERS, figures.counters
    return figures


def _hear(talk: Talk, recorded: Recorded, figures: Figures, wire: bytes, chance: random.Random) -> Talk:
    ended = None
    began_s = time.thread_time()
    try:
        talk.session.receive_data(wire, talk.now_ns)
    except recorded.raises as error:
        ended = type(error).__name__
    figures.slowest_s = max(figures.slowest_s, time.thread_time() - began_s)
    figures.most_held = max(figures.most_held, recorded.held(talk.session))
    return talk if ended is None else _anew(talk, recorded, figures, ended, chance)


def _anew(talk: Talk, recorded: Recorded, figures: Figures, why: str, chance: random.Random) -> Talk:
    figures.ended[why] += 1
    figures.sessions += 1
    figures.counters += talk.session.counters
    return _begin(recorded.bench, chance)


def _check_that_a_good_one_is_read(
    talk: Talk, recorded: Recorded, figures: Figures, chance: random.Random
) -> Talk:
    session, before = talk.session, sum(talk.session.counters[name] for name in recorded.read)
    for _ in range(FLUSHES):
        talk.now_ns += recorded.between_ns
        talk = _hear(talk, recorded, figures, recorded.good, chance)
    if talk.session is not session:
        return talk
    after = sum(talk.session.counters[name] for name in recorded.read)
    assert after > before, f"none of {FLUSHES} good messages was read"
    return talk


def _check_that_frames_come(talk: Talk, recorded: Recorded, figures: Figures) -> None:
    """From the device itself, in the same session or, where that ends, the next."""
    bench = BENCHES[recorded.bench]
    for _ in range(PATIENCE_S):
        before = len(talk.frames)
        try:
            talk.run(1.0)
        except (ProtocolError, TransportError, DeviceError) as error:
            figures.ended[f"at the end: {type(error).__name__}"] += 1
            figures.sessions += 1
            figures.counters += talk.session.counters
            talk.session = bench.sessions(lambda: talk.now_ns)()
            talk.device.disconnected(talk.now_ns)
            talk.connect()
        if len(talk.frames) - before > 0.9 * bench.rate_hz:
            figures.counters += talk.session.counters
            return
    raise AssertionError(f"no frames for {PATIENCE_S} s: {talk.session.status}")


@pytest.fixture
def quiet(caplog: pytest.LogCaptureFixture) -> None:
    """Warnings by the hundred thousand would be kept."""
    caplog.set_level(logging.CRITICAL, "drivers")


@pytest.mark.parametrize("case", CASES)
def test_some_thousand_damaged_messages_are_survived(shared: Path, case: str, quiet: None):
    figures = pour(CASES[case](shared), A_FEW, seed=1)
    assert sum(figures.counters.values()) > A_FEW / 2


@pytest.mark.soak
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("case", CASES)
def test_a_million_damaged_messages_are_survived(shared: Path, case: str, quiet: None):
    figures = pour(CASES[case](shared), MILLION, seed=2)
    print(f"\n{case}: {figures}")
    assert figures.grown_mb < GROWTH_MB
