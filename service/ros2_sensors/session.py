"""Messages of a ROS 2 node as frames, on the host's clock; no I/O.

The wire is a stream of messages, each after its length (uint32, little endian). header.stamp is of a clock
that is not the host's, and is learnt as a device's: messages can only come late.
"""

import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

from drivers.clock import ClockMap
from drivers.errors import ProtocolError
from drivers.frames import Frame, LaserScan
from drivers.watch import NOT_FINITE, WatchedSession
from service.encoding import decode_frame, frame_id
from service.errors import InputError
from service.ros2_sensors.config import Ros2SensorConfig

_LENGTH = struct.Struct("<I")
LARGEST_MESSAGE = 16_000_000  # bytes; a scan of 100 000 beams has 0.8 MB
MALFORMED_LIMIT = 10
FIRST_MESSAGE_TIMEOUT_S = 5.0  # the subscription has to reach the publisher first


def pack(payload: bytes) -> bytes:
    """A message as the wire carries it."""
    return _LENGTH.pack(len(payload)) + payload


class Ros2Session(WatchedSession):
    """One subscription's life.

    message_type   ROS 2 name
    what           its messages in counters, plural
    """

    _clock: ClockMap

    def __init__(self, config: Ros2SensorConfig, message_type: str, what: str) -> None:
        super().__init__(what, Counter(), MALFORMED_LIMIT)
        self._config = config
        self._type = message_type
        self._unread = bytearray()
        self._clock = ClockMap(1.0, latency_ns=round(config.latency_ms * 1e6))
        self.status = f"waiting for {config.topic}"

    def receive_data(self, data: bytes, arrived_ns: int) -> list[Frame]:
        self._unread += data
        read = (self._frame(payload, arrived_ns) for payload in self._messages())
        return [frame for frame in read if frame is not None]

    def tick(self, now_ns: int) -> None:
        limit_s = self._config.silence_timeout_s if self.identity else FIRST_MESSAGE_TIMEOUT_S
        nothing = (
            f"no {self._type} on {self._config.topic} for {limit_s:g} s; does a node publish it with "
            f"rmw_zenoh_cpp, on domain {self._config.domain}, at the router {self._config.router}?"
        )
        self._end_where_silent(now_ns, limit_s, True, nothing)

    def shutdown_request(self) -> bytes:
        return b""

    def _messages(self) -> Iterator[bytes]:
        """Those that are complete."""
        while len(self._unread) >= _LENGTH.size:
            (length,) = _LENGTH.unpack_from(self._unread)
            if length > LARGEST_MESSAGE:
                raise ProtocolError(
                    f"{self._config.topic}: a message of {length} bytes; at most {LARGEST_MESSAGE} are read"
                )
            end = _LENGTH.size + length
            if len(self._unread) < end:
                return
            payload = bytes(self._unread[_LENGTH.size : end])
            del self._unread[:end]
            yield payload

    def _frame(self, payload: bytes, arrived_ns: int) -> Frame | None:
        try:
            frame = decode_frame(self._type, payload, self._config.name, arrived_ns)
            self.identity = {"frame": frame_id(payload)}
        except InputError as error:
            self._malformed.bad(ProtocolError(f"{self._config.topic}: {error}"))
            return None
        self._malformed.good()
        if frame is None:
            self.counters[f"{self._what}_unusable"] += 1
            self._silence.dropped(NOT_FINITE)
            return None
        self._clock.observe(frame.stamp_ns + _lasts_ns(frame), arrived_ns)
        self._count(clock_resets=self._clock.resets)
        stamp_ns = self._clock.to_host_ns(frame.stamp_ns)
        if not self._gate.passes(stamp_ns, arrived_ns):
            return None
        self._silence.heard()
        self.status = "streaming"
        return replace(frame, stamp_ns=stamp_ns)


def _lasts_ns(frame: Frame) -> int:
    """From its stamp to the end of the measurement: a scan cannot be sent before its last ray."""
    return frame.beam_interval_ns * (frame.range_m.size - 1) if isinstance(frame, LaserScan) else 0
