"""A session and a fake device talking in virtual time: no wire, no thread, no waiting."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from drivers.frames import Frame
from drivers.link import Session
from simulators.device import FakeDevice

TICK_NS = 20_000_000
SECOND_NS = 1_000_000_000


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
            said = bytes(self.session.outbox)
            self.session.outbox.clear()
            self.sent += said
            self._deliver(self.device.receive_data(said, self.now_ns))

    def _deliver(self, data: bytes) -> None:
        if data:
            arrived_ns = self.now_ns + self.delay_ns()
            self.frames += self.session.receive_data(data, arrived_ns)
            self.session.tick(arrived_ns)  # as drivers.link does after each read
            if self.session.status not in self.statuses[-1:]:
                self.statuses.append(self.session.status)
            self.exchange()
