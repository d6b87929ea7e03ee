import threading
from collections import Counter

import pytest

from drivers.errors import ProtocolError, TransportError, UnforeseenError
from drivers.frames import OdometrySample
from service.offline.doctor.probe import KEPT_BYTES, Probe, listen, probe
from tests.drivers.scripted import ScriptedTransport

MS = 1_000_000


class Echo:
    """A session that makes a frame of every read, 10 ms apart, and counts."""

    def __init__(self, fail_at: int = 0, error: Exception | None = None) -> None:
        self.outbox = bytearray(b"start")
        self.counters: Counter[str] = Counter()
        self.status, self.identity = "streaming; warm", {"serial": "7"}
        self.clock_offset_ns = 5
        self.clock_sigma_ns = None
        self._fail_at, self._error = fail_at, error

    def receive_data(self, data: bytes, arrived_ns: int) -> list[OdometrySample]:
        self.counters["frames_received"] += 1
        self.counters["bytes_skipped"] += 3
        if self.counters["frames_received"] == self._fail_at:
            assert self._error is not None
            raise self._error
        stamp_ns = self.counters["frames_received"] * 10 * MS
        return [
            OdometrySample("base", stamp_ns, stamp_ns + 2 * MS, 0.0, 0.0, 0.0, (0.0, 0.0, 0.0), (0.0,) * 9)
        ]

    def tick(self, now_ns: int) -> None:
        pass

    def shutdown_request(self) -> bytes:
        return b"stop"


def run(transport: ScriptedTransport, session: Echo, measure_s: float = 1.0) -> Probe:
    return probe(lambda: transport, lambda: session, 1.0, measure_s, threading.Event())


def test_what_a_session_does_is_kept_whole():
    transport = ScriptedTransport([b"abc"] * 5)
    seen = run(transport, Echo())
    assert isinstance(seen.error, TransportError)  # the script's end, as a closed connection
    assert (seen.opened, seen.frames, seen.bytes_read, seen.bytes_written) == (True, 5, 15, 5)
    assert seen.rate_hz == pytest.approx(100.0)
    assert seen.delay_ms == (2.0, 2.0)
    assert seen.losses == {"bytes_skipped": 12}  # those before the first frame belong to the start
    assert bytes(seen.first_bytes) == b"abc" * 5
    assert transport.closed


def test_a_stall_at_the_end_lowers_the_rate():
    arrivals_ns = [number * 20 * MS for number in range(51)]
    seen = Probe(stamps_ns=arrivals_ns, arrivals_ns=arrivals_ns, ended_ns=1_010 * MS)
    assert seen.arrival_rate_hz == pytest.approx(50.0)
    seen.ended_ns = 3_000 * MS
    assert seen.arrival_rate_hz == pytest.approx(50.0 / 3.0)
    assert Probe(stamps_ns=[0, 20], arrivals_ns=[0, 20], ended_ns=3_000 * MS).arrival_rate_hz is None


@pytest.mark.parametrize(
    ("error", "kept"),
    [(ProtocolError("what is this?"), ProtocolError), (OverflowError("n"), UnforeseenError)],
)
def test_an_error_of_the_session_ends_the_look_and_is_kept(error: Exception, kept: type[Exception]):
    seen = run(ScriptedTransport([b"abc"] * 5), Echo(3, error))
    assert isinstance(seen.error, kept)
    assert seen.frames == 2


def test_listening_writes_nothing_and_keeps_no_more_than_it_needs():
    transport = ScriptedTransport([bytes(1000)] * 100)
    assert listen(lambda: transport, 60.0, threading.Event()) == bytes(KEPT_BYTES)
    assert transport.written == b""
    assert listen(lambda: ScriptedTransport([b"x"]), 60.0, threading.Event()) == b"x"
