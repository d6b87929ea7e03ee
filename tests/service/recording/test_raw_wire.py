"""Wires recorded and lived through again: the frames of then, bit for bit."""

from collections import Counter
from pathlib import Path

import pytest

from drivers.errors import TransportError
from drivers.frames import Frame, OdometrySample
from drivers.link import RawChunk
from service.encoding import BYTES, Message, decode_raw, encode_frame, encode_raw
from service.errors import InputError
from service.recording.mcap_reader import Recording
from service.recording.mcap_recorder import McapRecorder
from service.recording.mcap_source import open_session
from service.recording.raw_wire import WireReplay, utc_offset_ns
from tests.drivers.faulty_devices import BENCHES, linked
from tests.service.recording.sessions import T0_NS, drive
from tests.soaked import in_soak

OFFSET_NS = 1_700_000_000_123_456_789
CLOCK = {"clock": {"utc_offset_ns": str(OFFSET_NS)}}
NOISE = ("kind: garbage, at_s: 5, for_s: 1, share: 0.1", "kind: half_messages, at_s: 5, for_s: 1, share: 0.2")
IN_SHORT = {("lms100 cola_a", 0), ("mtig mtdata2", 1), ("create2", 0)}
LIVED_THROUGH = [
    *(
        (name, noise) if (name, k) in IN_SHORT else in_soak(name, noise)
        for name in BENCHES
        for k, noise in enumerate(NOISE)
    ),
    ("lux", "kind: silence, at_s: 5, for_s: 1.5"),
    ("utm30lx usb", "kind: cut, at_s: 5, for_s: 0.5"),
    ("mtig mtdata2", "kind: restart, at_s: 4, for_s: 0.5, link_drops: false"),
]


class AskingSession:
    """Asks at the first tick after an answer, and stamps a sample midway between request and answer."""

    def __init__(self) -> None:
        self.outbox = bytearray()
        self.counters: Counter[str] = Counter()
        self.status = ""
        self.identity: dict[str, str] = {}
        self.clock_offset_ns = None
        self.clock_sigma_ns = None
        self._requested_ns: int | None = None

    def tick(self, now_ns: int) -> None:
        if self._requested_ns is None:
            self._requested_ns = now_ns
            self.outbox += b"how far?"

    def receive_data(self, data: bytes, arrived_ns: int) -> list[OdometrySample]:
        stamp_ns, self._requested_ns = (self._requested_ns + arrived_ns) // 2, None
        return [OdometrySample("base", stamp_ns, arrived_ns, data[0], 0.0, 0.0, (0.0, 0.0, 0.0), (0.0,) * 9)]

    def shutdown_request(self) -> bytes:
        return b"bye"


def test_what_came_before_the_first_connection_is_passed_over():
    chunks = [
        RawChunk(1, "received", b"\x01"),
        RawChunk(2, "sent", b"how far?"),
        RawChunk(4, "connected"),
        RawChunk(4, "sent", b"how far?"),
        RawChunk(6, "received", b"\x02"),
    ]
    wire = WireReplay(AskingSession)
    (frame,) = [frame for chunk in chunks for frame in wire.take(chunk)]
    assert (frame.stamp_ns, frame.arrived_ns) == (5, 6)
    assert (wire.frames, wire.chunks_without_start, wire.requests_not_repeated) == (1, 2, 0)


def on_wire(frame: Frame) -> tuple[int, str, bytes]:
    message = encode_frame(frame, OFFSET_NS)
    return message.log_ns, message.channel, message.payload


@pytest.mark.parametrize(("name", "fault"), LIVED_THROUGH)
def test_a_driver_makes_the_very_frames_of_a_wire_with_faults(name: str, fault: str):
    link = linked(name, fault)
    link.run(9.0)
    assert len(link.passed_on) > 3.0 * BENCHES[name].rate_hz
    wire = WireReplay(BENCHES[name].sessions(lambda: link.now_ns))
    again = [frame for chunk in link.chunks for frame in wire.take(chunk)]
    assert list(map(on_wire, again)) == list(map(on_wire, link.passed_on))
    assert (wire.chunks_without_start, wire.requests_not_repeated) == (0, 0)


def test_a_driver_that_sends_otherwise_than_then_is_noticed():
    """Once it is silent where it asked, once it asks where it was silent."""
    chunks = [
        RawChunk(4, "connected"),
        RawChunk(6, "received", b"\x02"),
        RawChunk(6, "sent", b"how far?"),
        RawChunk(7, "sent", b"and now?"),
    ]
    wire = WireReplay(AskingSession)
    assert len([frame for chunk in chunks for frame in wire.take(chunk)]) == 1
    assert wire.requests_not_repeated == 2


@pytest.mark.parametrize("error", [TransportError("silent"), OverflowError("int too large")])
def test_a_session_that_gives_up_in_a_tick_is_replaced_at_the_next_connection(error: Exception):
    class Impatient(AskingSession):
        def tick(self, now_ns: int) -> None:
            if now_ns == 13:
                raise error
            super().tick(now_ns)

    chunks = [
        RawChunk(10, "connected"),
        RawChunk(10, "sent", b"?"),
        RawChunk(13, "waited"),
        RawChunk(14, "received", b"\x01"),
        RawChunk(21, "connected"),
        RawChunk(21, "sent", b"?"),
        RawChunk(23, "received", b"\x02"),
    ]
    wire = WireReplay(Impatient)
    assert [frame.stamp_ns for chunk in chunks for frame in wire.take(chunk)] == [22]


@pytest.mark.parametrize(
    "chunk",
    [
        RawChunk(1, "connected"),
        RawChunk(1, "waited"),
        RawChunk(123_456_789_012_345, "received", bytes(range(256)) * 40),
        RawChunk(2, "sent", b"\x02sRN"),
    ],
)
def test_a_chunk_survives_to_the_nanosecond(chunk: RawChunk):
    message = encode_raw("front", chunk, OFFSET_NS)
    assert (message.channel, message.type) == ("front/raw", BYTES)
    assert message.log_ns == chunk.at_ns + OFFSET_NS
    assert decode_raw(message.payload, message.log_ns, OFFSET_NS) == chunk


def test_bytes_of_another_program_are_no_chunk(tmp_path: Path):
    payload = encode_raw("front", RawChunk(1, "sent", b"x"), 0).payload.replace(b"sent", b"what")
    with pytest.raises(
        InputError, match="raw bytes labelled 'what'; expected connected, received, waited, sent"
    ):
        decode_raw(payload, 1, 0)


def record(tmp_path: Path, messages: list[Message], metadata: dict[str, dict[str, str]]) -> Path:
    recorder = McapRecorder(tmp_path, "veh1", keep_free_bytes=0, metadata=metadata)
    recorder.start()
    for message in messages:
        recorder.put(message)
    (session,) = recorder.finish()
    return session


def test_a_recording_without_its_clock_cannot_tell_when(tmp_path: Path):
    raw = encode_raw("front", RawChunk(T0_NS, "connected"), 0)
    with pytest.raises(InputError, match=r"no clock\.utc_offset_ns"):
        utc_offset_ns(Recording([record(tmp_path, [raw], {})]))


def test_a_replay_does_not_look_at_the_wire(tmp_path: Path):
    raw = [encode_raw("front", RawChunk(T0_NS + k, "received", b"x"), 0) for k in range(5)]
    session = open_session([record(tmp_path, [*drive(3), *raw], CLOCK)])
    assert session.sensors == {"/base/odom": "base", "/front/scan": "front"}
    assert len(list(session.steps())) == 6
