"""The one loop all drivers share: connect, pump, reconnect.

A session is the life of one connection and does no I/O: bytes and time go in, frames come out, what it
wants to send is in its outbox. A new session per connection, so no stale buffer survives a cable pull.
"""

import logging
import re
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol

from drivers.errors import DeviceError, ProtocolError, TransportError, UnforeseenError, contained
from drivers.frames import Frame, GnssFix
from drivers.transport import Transport

log = logging.getLogger(__name__)

Sink = Callable[[Frame], None]
ChunkKind = Literal["connected", "received", "waited", "sent"]


@dataclass(frozen=True, slots=True)
class RawChunk:
    """One event on a wire: together they are all inputs of a session, which repeats itself by them.

    connected    a new connection, hence a new session; no bytes
    received     bytes as they came
    waited       nothing came within READ_TIMEOUT_S; no bytes
    sent         bytes that the session had in its outbox after the tick of at_ns; its shutdown request is
                 left out

    After each of the first three the session is ticked, with the chunk's own at_ns.
    """

    at_ns: int  # host monotonic
    kind: ChunkKind
    data: bytes = b""


RawTee = Callable[[RawChunk], None]

READ_TIMEOUT_S = 0.02  # how often a session's timers run when the wire is silent
FIRST_RETRY_S, LAST_RETRY_S = 0.25, 0.5  # back-off after a lost link: a device is to be back within 2 s
DEVICE_ERROR_RETRY_S = 10.0
MAX_REPORTED = 8  # different errors
PROVEN_AFTER_S = 5.0  # a link that lived this long starts its back-off again
CLOCK_KNOWN_NS = 2_000_000  # standard deviation of a stamp that is handed on; 2 mm at 1 m/s
CLOCK_PATIENCE_NS = 2_000_000_000  # after the first frame; then frames are handed on with any deviation


class Session(Protocol):
    """One connection's life without I/O."""

    outbox: bytearray
    counters: Counter[str]  # what was received, dropped, resynchronised; names are for people
    status: str  # one line for health: "logging in", "streaming", "laser contaminated"
    identity: dict[str, str]  # what the device reports of itself: firmware, serial number

    def receive_data(self, data: bytes, arrived_ns: int) -> Sequence[Frame]:
        """Take bytes as they came. Raises ProtocolError, DeviceError."""
        ...

    def tick(self, now_ns: int) -> None:
        """Run timers: resend, probe, time out. Raises TransportError on silence, DeviceError.

        It is called after the connection is made, after each receive_data and after each read that timed
        out; now_ns is the host time at which that happened.
        """
        ...

    def shutdown_request(self) -> bytes:
        """Bytes to send before a clean close, b"" for none."""
        ...

    @property
    def clock_offset_ns(self) -> int | None:
        """Host minus device clock, None where the device has none or it is not known yet."""
        ...

    @property
    def clock_sigma_ns(self) -> int | None:
        """Standard deviation of that offset, hence of stamps; None where the device has no clock."""
        ...


@dataclass(slots=True)
class LinkHealth:
    """State of one device's link. Written by its reader thread, read by any thread."""

    name: str
    state: str = "connecting"  # connecting | starting | streaming | down
    status: str = ""  # of the newest session; "" while it connects
    last_error: str = ""
    connects: int = 0
    frames: int = 0  # GNSS fixes, which come beside the samples, are not counted
    bytes_read: int = 0
    last_frame_ns: int = 0  # host monotonic, 0 before the first
    delay_ns: int = 0  # from the newest frame's stamp to its arrival
    clock_offset_ns: int | None = None
    clock_sigma_ns: int | None = None
    counters: Counter[str] = field(default_factory=Counter)  # over all connections
    identity: dict[str, str] = field(default_factory=dict)


def run_link(
    health: LinkHealth,
    open_transport: Callable[[], Transport],
    new_session: Callable[[], Session],
    sink: Sink,
    stop: threading.Event,
    tee: RawTee | None = None,
) -> None:
    """Run the link of one device until `stop` is set; never raises for what a device, cable or driver
    does. What `sink` and `tee` raise passes.

    `tee` receives every event on the wire before the session does; it must not block.
    """
    retry_s, log_of_errors = FIRST_RETRY_S, ErrorLog(health.name)
    while not stop.is_set():
        health.state, health.status = "connecting", ""
        began_s = time.monotonic()
        try:
            with contained(open_transport) as transport:
                health.connects += 1
                health.state = "starting"
                _pump(transport, new_session(), health, sink, stop, tee)
            return
        except (TransportError, ProtocolError) as error:
            if stop.is_set():
                return
            if time.monotonic() - began_s > PROVEN_AFTER_S:
                retry_s = FIRST_RETRY_S
            wait_s, retry_s = retry_s, min(2.0 * retry_s, LAST_RETRY_S)
            _report(health, error, wait_s, log_of_errors)
        except (DeviceError, UnforeseenError) as error:
            wait_s = DEVICE_ERROR_RETRY_S
            if isinstance(error, UnforeseenError):
                health.counters = health.counters + Counter(driver_faults=1)
            _report(health, error, wait_s, log_of_errors)
        stop.wait(wait_s)


class ErrorLog:
    """Warns of each loss of a link that worked, and of each new error; not of one of the last MAX_REPORTED at
    each retry (two may alternate), nor where its figures alone are others.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._reported: deque[str] = deque(maxlen=MAX_REPORTED)  # since it worked

    def add(self, error: Exception, wait_s: float, worked: bool) -> None:
        """worked: frames came on the connection that ended so."""
        text, cause = str(error), None
        kind = re.sub(r"\d+", "#", text)
        if worked:
            self._reported.clear()
        if kind in self._reported:
            level = logging.DEBUG
        elif isinstance(error, UnforeseenError):
            level, cause = logging.ERROR, error.__cause__
        else:
            level = logging.WARNING
        log.log(level, "%s: %s; reconnecting in %.2g s", self._name, text, wait_s, exc_info=cause)
        if kind not in self._reported:
            self._reported.append(kind)


def _report(health: LinkHealth, error: Exception, wait_s: float, log_of_errors: ErrorLog) -> None:
    log_of_errors.add(error, wait_s, worked=health.state == "streaming")
    health.state, health.last_error = "down", f"{error}; reconnecting in {wait_s:.2g} s"


def _pump(
    transport: Transport,
    session: Session,
    health: LinkHealth,
    sink: Sink,
    stop: threading.Event,
    tee: RawTee | None,
) -> None:
    before = Counter(health.counters)
    gate = ClockGate()
    now_ns = time.monotonic_ns()
    if tee is not None:
        tee(RawChunk(now_ns, "connected"))
    try:
        while not stop.is_set():
            contained(session.tick, now_ns)
            if session.outbox:
                if tee is not None:
                    tee(RawChunk(now_ns, "sent", bytes(session.outbox)))
                contained(transport.write, bytes(session.outbox))
                session.outbox.clear()
            data = contained(transport.read, READ_TIMEOUT_S)
            now_ns = time.monotonic_ns()
            if tee is not None:
                tee(RawChunk(now_ns, "received" if data else "waited", data))
            if data:
                health.bytes_read += len(data)
                for frame in contained(session.receive_data, data, now_ns):
                    if health.state != "streaming":
                        health.state = "streaming"
                        log.info("%s: streaming%s", health.name, _identity_text(session.identity))
                    health.frames += not isinstance(frame, GnssFix)  # rates are those of what is mapped
                    health.last_frame_ns, health.delay_ns = now_ns, now_ns - frame.stamp_ns
                    if gate.lets_through(session.clock_sigma_ns, now_ns):
                        sink(frame)
                    else:
                        kind = "fixes" if isinstance(frame, GnssFix) else "frames"
                        session.counters[f"{kind}_before_clock"] += 1
            health.status = session.status
            health.clock_offset_ns = session.clock_offset_ns
            health.clock_sigma_ns = session.clock_sigma_ns
            health.counters = before + session.counters
            health.identity = session.identity
        if request := session.shutdown_request():
            transport.write(request)
    finally:
        health.counters = before + session.counters
        health.status = session.status


class ClockGate:
    """Holds back the first frames of a connection, until the device's clock is known.

    On a busy machine the very first message is read up to 0.1 s late, and its stamp is as late: a map that
    begins with it is off by the distance driven meanwhile.
    """

    def __init__(self) -> None:
        self._open = False
        self._first_ns: int | None = None

    def lets_through(self, clock_sigma_ns: int | None, arrived_ns: int) -> bool:
        if self._open:
            return True
        if self._first_ns is None:
            self._first_ns = arrived_ns
        self._open = (
            clock_sigma_ns is None
            or clock_sigma_ns <= CLOCK_KNOWN_NS
            or arrived_ns - self._first_ns > CLOCK_PATIENCE_NS
        )
        return self._open


def _identity_text(identity: dict[str, str]) -> str:
    return f" ({', '.join(f'{key} {value}' for key, value in identity.items())})" if identity else ""
