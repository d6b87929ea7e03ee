"""Runs a sensor's own session for some seconds and keeps its frames and counters.

It does what the live driver does on the first connection, and nothing more: the session decides what is
written.
"""

import statistics
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from drivers.errors import DriverError, TransportError, contained
from drivers.frames import Frame
from drivers.link import Session
from drivers.sensor_kind import SensorKind
from drivers.transport import Transport

READ_TIMEOUT_S = 0.02  # as drivers.link has it
KEPT_BYTES = 16_384
STALL_PERIODS = 10  # longer than the pauses of a wire that bunches frames
TALK_S = 0.3  # how long the answer is read that shows that the device understands


@dataclass(slots=True)
class Probe:
    """What happened on one wire during the test. Times are the host's monotonic clock."""

    error: DriverError | None = None
    opened: bool = False
    first_bytes: bytearray = field(default_factory=bytearray)
    bytes_read: int = 0
    bytes_written: int = 0
    stamps_ns: list[int] = field(default_factory=list)
    arrivals_ns: list[int] = field(default_factory=list)
    status: str = ""
    identity_at_first: dict[str, str] = field(default_factory=dict)  # by the config alone
    identity: dict[str, str] = field(default_factory=dict)
    counters_at_first: Counter[str] = field(default_factory=Counter)
    counters: Counter[str] = field(default_factory=Counter)
    clock_offset_ns: int | None = None
    seconds: float = 0.0  # from the open wire to the end
    ended_ns: int = 0

    @property
    def frames(self) -> int:
        return len(self.stamps_ns)

    @property
    def reported(self) -> dict[str, str]:
        """Identity that the device itself has reported."""
        return {key: text for key, text in self.identity.items() if self.identity_at_first.get(key) != text}

    @property
    def rate_hz(self) -> float | None:
        """Rate by the stamps, which do not depend on the wire's bunching; None below three frames."""
        span_ns = self.stamps_ns[-1] - self.stamps_ns[0] if self.frames >= 3 else 0
        return (self.frames - 1) * 1e9 / span_ns if span_ns > 0 else None

    @property
    def arrival_rate_hz(self) -> float | None:
        """Frames a second that really came; None below three frames. A stall at the end counts."""
        if self.frames < 3:
            return None
        span_ns = self.arrivals_ns[-1] - self.arrivals_ns[0]
        quiet_ns = self.ended_ns - self.arrivals_ns[-1]
        if quiet_ns > STALL_PERIODS * span_ns / (self.frames - 1):
            span_ns += quiet_ns
        return (self.frames - 1) * 1e9 / span_ns if span_ns > 0 else None

    @property
    def delay_ms(self) -> tuple[float, float] | None:
        """Median and largest time from a frame's stamp to its arrival."""
        if not self.frames:
            return None
        delays = [(a - s) / 1e6 for s, a in zip(self.stamps_ns, self.arrivals_ns, strict=True)]
        return statistics.median(delays), max(delays)

    @property
    def losses(self) -> dict[str, int]:
        """Counters of losses since the first frame."""
        since = self.counters - self.counters_at_first
        return {name: count for name, count in sorted(since.items()) if any(word in name for word in _LOSSES)}


_LOSSES = (
    *("missed", "malformed", "checksum", "skipped", "cut", "truncated", "damaged", "fault", "failure"),
    *("duplicate", "repeated", "out_of_order", "not_as_configured", "unreadable", "reset", "restart"),
)


def probe(
    kind: SensorKind,
    config: Any,
    start_up_s: float,
    measure_s: float,
    stop: threading.Event,
    until_answered: bool = False,
) -> Probe:
    """Open, talk until the first frame (start_up_s at most), measure for measure_s, part in good order.

    until_answered    end as soon as the session knows who is there: enough to see that settings fit
    """
    seen = Probe()
    try:
        with kind.open_transport(config) as transport:
            seen.opened = True
            session = kind.session_maker(config)()
            seen.identity_at_first = dict(session.identity)
            began_s = time.monotonic()
            end_s = began_s + start_up_s
            try:
                while not stop.is_set() and time.monotonic() < end_s:
                    frames = _step(seen, transport, session)
                    if frames and not seen.frames:
                        seen.counters_at_first = Counter(session.counters)
                        end_s = time.monotonic() + measure_s
                    seen.stamps_ns += [frame.stamp_ns for frame in frames]
                    seen.arrivals_ns += [frame.arrived_ns for frame in frames]
                    if until_answered and (frames or session.identity != seen.identity_at_first):
                        end_s = min(end_s, time.monotonic() + TALK_S)
                if request := session.shutdown_request():
                    transport.write(request)
            finally:
                seen.seconds, seen.ended_ns = time.monotonic() - began_s, time.monotonic_ns()
                seen.status, seen.identity = session.status, dict(session.identity)
                seen.counters, seen.clock_offset_ns = Counter(session.counters), session.clock_offset_ns
    except DriverError as error:
        seen.error = error
    return seen


def _step(seen: Probe, transport: Transport, session: Session) -> list[Frame]:
    contained(session.tick, time.monotonic_ns())
    if session.outbox:
        seen.bytes_written += len(session.outbox)
        transport.write(bytes(session.outbox))
        session.outbox.clear()
    data = transport.read(READ_TIMEOUT_S)
    if not data:
        return []
    arrived_ns = time.monotonic_ns()
    seen.bytes_read += len(data)
    seen.first_bytes += data[: KEPT_BYTES - len(seen.first_bytes)]
    return list(contained(session.receive_data, data, arrived_ns))


def listen(open_transport: Callable[[], Transport], seconds: float, stop: threading.Event) -> bytes:
    """Bytes that come by themselves; nothing is written. b"" also where the wire cannot be opened."""
    heard = bytearray()
    try:
        with open_transport() as transport:
            end_s = time.monotonic() + seconds
            while len(heard) < KEPT_BYTES and time.monotonic() < end_s and not stop.is_set():
                heard += transport.read(READ_TIMEOUT_S)
    except TransportError:
        pass
    return bytes(heard[:KEPT_BYTES])
