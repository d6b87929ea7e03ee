"""From the bytes of a recorded wire back to frames: a fault in the field becomes a test.

recording = Recording([Path("veh1_20261121T101500Z_0001.mcap")])
frames = list(frames_from_wire(raw_chunks(recording, "front"), lambda: Lms100Session(config)))
"""

import logging
from collections.abc import Callable, Iterable, Iterator

from drivers.errors import DriverError
from drivers.frames import Frame
from drivers.link import ClockGate, RawChunk, Session
from service.encoding import BYTES, decode_raw
from service.errors import InputError
from service.recording.mcap_reader import Recording

log = logging.getLogger(__name__)


def raw_chunks(recording: Recording, sensor: str) -> Iterator[RawChunk]:
    """What happened on the sensor's wire, at the host's monotonic times of then. Raises InputError."""
    topic = f"/{sensor}/raw"
    if not any((t.name, t.type) == (topic, BYTES) for t in recording.topics):
        raise InputError(
            f"{recording.paths[0]}: no {topic}; it is recorded where the config says recording: {{raw: true}}"
        )
    try:
        offset_ns = int(recording.metadata["clock"]["utc_offset_ns"])
    except (KeyError, ValueError) as error:
        raise InputError(f"{recording.paths[0]}: no clock.utc_offset_ns among its metadata") from error
    for message in recording.messages([topic]):
        yield decode_raw(message.payload, message.log_ns, offset_ns)


def frames_from_wire(chunks: Iterable[RawChunk], new_session: Callable[[], Session]) -> Iterator[Frame]:
    """Let sessions live through it again, one a connection; the frames they make, in order.

    new_session is what the registry's `session_maker` makes for the sensor's config. They are the frames of
    then as long as the session says what it said then, for its ticks come when it spoke. Chunks before the
    first connection are passed over: a session cannot begin in mid-stream. Where a session gives up, the
    rest of its connection is passed over, as the link did, and so are the frames that it held back.
    """
    session: Session | None = None
    gate = ClockGate()
    for chunk in chunks:
        if chunk.kind == "connected":
            session, gate = new_session(), ClockGate()
        elif session is not None:
            try:
                if chunk.kind == "received":
                    for frame in session.receive_data(chunk.data, chunk.at_ns):
                        if gate.lets_through(session.clock_sigma_ns, chunk.at_ns):
                            yield frame
                else:
                    session.tick(chunk.at_ns)
                    session.outbox.clear()
            except DriverError as error:
                log.info("the session ends at %d ns: %s", chunk.at_ns, error)
                session = None
