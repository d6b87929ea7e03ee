"""A session and a fake device talking in virtual time: no wire, no thread, no waiting."""

import heapq
import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from drivers.frames import Frame
from drivers.link import Session
from simulators.device import FakeDevice

TICK_NS = 20_000_000
SECOND_NS = 1_000_000_000


def sent_until(device: FakeDevice, now_ns: int, end_ns: int) -> Iterator[tuple[int, bytes]]:
    """What leaves a device from now on, with its times."""
    while (due_ns := device.next_due_ns(now_ns)) is not None and due_ns <= end_ns:
        now_ns = max(now_ns, due_ns)
        yield now_ns, device.due(now_ns)


@dataclass
class Talk:
    """Carries bytes between the two; `delay_ns` is what the network adds to what the device sends."""

    session: Session
    device: FakeDevice
    now_ns: int = 1_000 * SECOND_NS
    delay_ns: Callable[[], int] = lambda: 100_000
    frames: list[Frame] = field(default_factory=list)
    statuses: list[str] = field(default_factory=list)
    sent: bytearray = field(default_factory=bytearray)
    room: Any = None  # what the device measures

    def connect(self) -> "Talk":
        self._deliver(self.device.connected(self.now_ns))
        return self

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> "Talk":
        """Let that much virtual time pass, or stop where `until` is true at a tick."""
        end_ns = self.now_ns + round(seconds * SECOND_NS)
        tick_ns = self.now_ns
        while self.now_ns < end_ns and not until():
            self.session.tick(self.now_ns)
            self.exchange()
            tick_ns += TICK_NS
            while (due_ns := self.device.next_due_ns(self.now_ns)) is not None and due_ns <= tick_ns:
                self.now_ns = max(self.now_ns, due_ns)
                self._deliver(self.device.due(self.now_ns))
            self.now_ns = max(self.now_ns, tick_ns)
        return self

    def exchange(self) -> None:
        """Carry what the session has to send, and what the device answers."""
        while self.session.outbox:
            sent = bytes(self.session.outbox)
            self.session.outbox.clear()
            self.sent += sent
            self._deliver(self.device.receive_data(sent, self.now_ns))

    def _deliver(self, data: bytes) -> None:
        if data:
            arrived_ns = self.now_ns + self.delay_ns()
            self.frames += self.session.receive_data(data, arrived_ns)
            self.session.tick(arrived_ns)  # as drivers.link does after each read
            if self.session.status not in self.statuses[-1:]:
                self.statuses.append(self.session.status)
            self.exchange()


class LateTalk:
    """Session and device with a wire between that delivers in order but late, as threads and buses do.

    delay_ns(sent_ns) is what a message of the device takes; the session is ticked after every read and 20 ms
    after it looked last, as drivers.link does.
    """

    TO_DEVICE_NS = 60_000
    WAKE_UP_NS = 40_000

    def __init__(
        self,
        session: Session,
        device: FakeDevice,
        delay_ns: Callable[[int], int],
        now_ns: int = 1_000 * SECOND_NS,
    ) -> None:
        self.session, self.device, self.now_ns = session, device, now_ns
        self.frames: list[Frame] = []
        self._delay_ns = delay_ns
        self._events: list[tuple[int, int, Callable[[bytes], None], bytes]] = []  # time, number, what, data
        self._number = itertools.count()
        self._last_arrival_ns = self._looks_at_ns = 0
        self._connect()

    def reconnect(self, session: Session) -> "LateTalk":
        """A new session with the same device; data in transit are lost."""
        self.device.disconnected(self.now_ns)
        self._events.clear()
        self.session = session
        self._connect()
        return self

    def run(self, seconds: float) -> "LateTalk":
        end_ns = self.now_ns + round(seconds * SECOND_NS)
        while True:
            due_ns = self.device.next_due_ns(self.now_ns)
            if due_ns is not None and max(due_ns, self.now_ns) <= self._events[0][0]:
                self.now_ns = max(due_ns, self.now_ns)
                if self.now_ns >= end_ns:
                    return self
                self._send(self.device.due(self.now_ns), self.now_ns)
                continue
            if self._events[0][0] >= end_ns:
                self.now_ns = end_ns
                return self
            self.now_ns, _, what, data = heapq.heappop(self._events)
            what(data)

    def _connect(self) -> None:
        self._send(self.device.connected(self.now_ns), self.now_ns)
        self._plan_look(self.now_ns)

    def _put(self, at_ns: int, what: Callable[[bytes], None], data: bytes = b"") -> None:
        heapq.heappush(self._events, (at_ns, next(self._number), what, data))

    def _send(self, data: bytes, sent_ns: int) -> None:
        if data:
            self._last_arrival_ns = max(self._last_arrival_ns, sent_ns + self._delay_ns(sent_ns))
            self._put(self._last_arrival_ns, self._arrive, data)

    def _arrive(self, data: bytes) -> None:
        self.frames += self.session.receive_data(data, self.now_ns)
        self._plan_look(self.now_ns + self.WAKE_UP_NS)

    def _plan_look(self, at_ns: int) -> None:
        self._looks_at_ns = at_ns
        self._put(at_ns, self._look)

    def _look(self, _: bytes) -> None:
        if self.now_ns != self._looks_at_ns:
            return  # there was a read in between
        self.session.tick(self.now_ns)
        sent = bytes(self.session.outbox)
        self.session.outbox.clear()
        if sent:
            self._put(self.now_ns + self.TO_DEVICE_NS, self._hear, sent)
        self._plan_look(self.now_ns + TICK_NS)

    def _hear(self, data: bytes) -> None:
        self._send(self.device.receive_data(data, self.now_ns), self.now_ns)
