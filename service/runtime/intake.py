"""Fixes the order of all frames and commands, which everything downstream keeps.

A frame is encoded once, in the thread of its reader. The same bytes go to the sinks and to the mapper's
process, so a replay of the recording gives the same poses.
"""

import json
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

from drivers.frames import Frame
from service.encoding import LogClock, Message, encode_event, encode_frame
from service.mapper.mapping_session import SessionAction
from service.runtime import mapper_messages as msg
from service.runtime.host_time import HostTime
from service.runtime.mapper_link import MapperLink

Answered = Callable[[msg.Answer], None]


class Intake:
    """Thread-safe; a call waits at most for the encoding of another thread's frame.

    put    takes a message for all sinks, and only queues it
    """

    def __init__(self, link: MapperLink, host_time: HostTime, put: Callable[[Message], Any]) -> None:
        self._link = link
        self._host_time = host_time
        self._put = put
        self._log_clock = LogClock()
        self._lock = threading.Lock()
        self._is_closed = False
        self.paused = False

    def put(self, frame: Frame) -> None:
        """Give a frame to the sinks and to the mapper. After close() frames are ignored."""
        with self._lock:
            if self._is_closed:
                return
            log_ns = self._log_clock.next_ns(self._host_time.unix_ns(frame.arrived_ns))
            message = encode_frame(frame, self._host_time.offset_ns, log_ns)
            self._put(message)
            number = self._link.next_number()
            self._link.submit(
                msg.FrameItem(number, log_ns, frame.arrived_ns, frame.sensor, message.type, message.payload)
            )

    def mark(self, event: Mapping[str, Any], then: Callable[[Message], None]) -> str:
        """Put an event among the frames; `then` takes it, encoded, before any later frame is recorded.

        Why that was not done, "" if it was. `then` waits for nothing and may call the requests below.
        """
        with self._lock:
            if self._is_closed:
                return "the service is stopping"
            then(self._event(event))
            return ""

    def request_session(self, action: SessionAction, log_ns: int, answered: Answered) -> None:
        """Within `then` of a mark: pause, resume or reset the mapper at its place."""
        if action != "reset_map":
            self.paused = action == "pause"
        self._link.submit(msg.SessionItem(self._link.next_number(), log_ns, action), answered)

    def request_map(self, folder: str, version: int, log_ns: int, answered: Answered) -> None:
        """Within `then` of a mark: have the mapper begin again in a stored map at its place."""
        self._link.submit(msg.LoadItem(self._link.next_number(), log_ns, folder, version), answered)

    def request_profile(self, mapping: Mapping[str, Any], log_ns: int, answered: Answered) -> None:
        """Within `then` of a mark: have the mapper begin again at its place, as in this section."""
        self._link.submit(msg.SwitchItem(self._link.next_number(), log_ns, mapping), answered)

    def request_graph(self, name: str, payload: Mapping[str, Any], log_ns: int, answered: Answered) -> None:
        """Within `then` of a mark: request something of the graph."""
        self._link.submit(msg.GraphItem(self._link.next_number(), log_ns, name, payload), answered)

    def request_tiles(self, log_ns: int, answered: Answered) -> None:
        """Within `then` of a mark: have all tiles up to it handed over."""
        self._link.submit(msg.TilesItem(self._link.next_number(), log_ns), answered)

    def hand_over_tiles(self, then: Callable[[], None]) -> str:
        """Have all tiles up to now handed over, which is not recorded; why that is not done, "" if it is.

        then    called when they are; waits for nothing
        """
        with self._lock:
            if self._is_closed:
                return "the service is stopping"
            log_ns = self._log_ns_now()
            self.request_tiles(log_ns, lambda answer: then())
            return ""

    def log_ns(self) -> int:
        """A log time after all before, for what comes of frames."""
        with self._lock:
            return self._log_ns_now()

    def close(self) -> None:
        """Take no more."""
        with self._lock:
            self._is_closed = True

    def _log_ns_now(self) -> int:
        return self._log_clock.next_ns(self._host_time.unix_ns(time.monotonic_ns()))

    def _event(self, event: Mapping[str, Any]) -> Message:
        log_ns = self._log_ns_now()
        return encode_event(json.dumps(dict(event)), log_ns, log_ns)
