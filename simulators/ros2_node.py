"""A fake ROS 2 node that publishes what one sensor measures, stamped by a clock of its own. No I/O."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

from drivers.frames import Frame
from service.encoding import encode_frame
from simulators.device import CATCH_UP_NS, TURNS_SKIPPED, turns_to_skip

Measure = Callable[[int], Frame]  # host monotonic time -> what is measured from then on


@dataclass(frozen=True, slots=True)
class NodeSetup:
    period_ns: int
    lasts_ns: int = 0  # one measurement: it is sent at its end
    clock_ahead_ns: int = 1_700_000_000_000_000_000  # of the node: its Unix time minus the host's monotonic
    clock_drift_ppm: float = 0.0


class FakeNode:
    """A FakeDevice that only sends: `due` returns the payload of one message."""

    def __init__(self, measure: Measure, setup: NodeSetup) -> None:
        self._measure = measure
        self._setup = setup
        self._begun_ns = self._next_ns = 0  # of the measurement that is sent next
        self._jumped_ns = 0
        self.counters: Counter[str] = Counter()

    def connected(self, now_ns: int) -> bytes:
        self._begun_ns = self._begun_ns or now_ns
        self._next_ns = now_ns
        return b""

    def receive_data(self, data: bytes, now_ns: int) -> bytes:
        return b""

    def next_due_ns(self, now_ns: int) -> int | None:
        return self._next_ns + self._setup.lasts_ns

    def due(self, now_ns: int) -> bytes:
        skipped = turns_to_skip(
            now_ns - self._next_ns - self._setup.lasts_ns, self._setup.period_ns, CATCH_UP_NS
        )
        self.counters[TURNS_SKIPPED] += skipped
        at_ns = self._next_ns + skipped * self._setup.period_ns
        self._next_ns = at_ns + self._setup.period_ns
        return encode_frame(self._measure(at_ns), self._clock_ns(at_ns) - at_ns).payload

    def disconnected(self, now_ns: int) -> None:
        return

    def jump_clock(self, seconds: float) -> None:
        self._jumped_ns += round(seconds * 1e9)

    def _clock_ns(self, at_ns: int) -> int:
        """Unix time by the node's clock."""
        drifted_ns = round((at_ns - self._begun_ns) * self._setup.clock_drift_ppm * 1e-6)
        return at_ns + self._setup.clock_ahead_ns + self._jumped_ns + drifted_ns
