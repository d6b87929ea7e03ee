"""Frames from the bytes of a recorded wire."""

import logging
from collections.abc import Callable

from drivers.errors import DriverError, contained
from drivers.frames import Frame
from drivers.link import ClockGate, RawChunk, Session
from service.encoding import BYTES
from service.errors import InputError
from service.recording.mcap_reader import Recording

log = logging.getLogger(__name__)


def raw_topics(recording: Recording) -> dict[str, str]:
    """Sensor -> its topic of raw bytes, as far as there are any."""
    found = {}
    for topic in recording.topics:
        parts = topic.name.split("/")
        if len(parts) == 3 and parts[2] == "raw" and topic.type == BYTES and topic.count:
            found[parts[1]] = topic.name
    return found


def utc_offset_ns(recording: Recording) -> int:
    """Unix time minus the host's monotonic clock of then. Raises InputError."""
    try:
        return int(recording.metadata["clock"]["utc_offset_ns"])
    except (KeyError, ValueError) as error:
        raise InputError(f"{recording.paths[0]}: no clock.utc_offset_ns among its metadata") from error


class WireReplay:
    """Sessions of one sensor's driver on its recorded wire, one a connection, ticked as the link ticked them.

    The frames are those of then, to the bit, where the driver is the same and no chunk is missing. Where a
    session raises, the rest of its connection is passed over, as the link closed it, and so are the frames
    that it kept back. Chunks before the first connection are passed over: a session cannot begin in
    mid-stream.

    new_session           what the registry's `session_maker` makes for the sensor's config
    frames                how many frames were given out
    chunks_without_start  chunks that were passed over for want of a connection before them
    requests_not_repeated times the driver of then sent and that of today does not, or the reverse;
                          its frames may then differ
    """

    def __init__(self, new_session: Callable[[], Session]) -> None:
        self._new_session = new_session
        self._session: Session | None = None
        self._connected = False
        self._gate = ClockGate()
        self.frames = 0
        self.chunks_without_start = 0
        self.requests_not_repeated = 0

    @property
    def counts(self) -> dict[str, int]:
        names = ("frames", "chunks_without_start", "requests_not_repeated")
        return {name: getattr(self, name) for name in names}

    def take(self, chunk: RawChunk) -> list[Frame]:
        """The frames that the driver makes of it, in order."""
        if chunk.kind == "connected":
            self._session, self._gate, self._connected = self._new_session(), ClockGate(), True
        session = self._session
        if session is None:
            self.chunks_without_start += not self._connected
            return []
        if chunk.kind != "connected":  # some sessions have something to send before their first tick
            self.requests_not_repeated += bool(session.outbox) is not (chunk.kind == "sent")
            session.outbox.clear()
        frames: list[Frame] = []
        try:
            if chunk.kind == "received":
                frames = self._received(session, chunk)
            if chunk.kind != "sent":
                contained(session.tick, chunk.at_ns)
        except DriverError as error:
            log.info("the session ends at %d ns: %s", chunk.at_ns, error)
            self._session = None
        self.frames += len(frames)
        return frames

    def _received(self, session: Session, chunk: RawChunk) -> list[Frame]:
        return [
            frame
            for frame in contained(session.receive_data, chunk.data, chunk.at_ns)
            if self._gate.lets_through(session.clock_sigma_ns, chunk.at_ns)
        ]
