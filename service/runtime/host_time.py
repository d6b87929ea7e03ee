"""Host monotonic clock -> Unix time, by one offset for the life of the service.

Everything is measured on the monotonic clock; Unix time only labels it at output. The label's offset is
fixed at start, so a step of the wall clock (NTP, an operator) in mid-session never tears the map: it is
reported, not applied.
"""

import time
from dataclasses import dataclass

READINGS = 5
STEP_NS = 100_000_000  # less is slewing or a coarse read, not a step


@dataclass(frozen=True, slots=True)
class HostTime:
    """unix_ns = monotonic_ns + offset_ns"""

    offset_ns: int

    @classmethod
    def now(cls) -> "HostTime":
        """Read both clocks; of several readings the one that took least time is used."""
        best: tuple[int, int] | None = None
        for _ in range(READINGS):
            before = time.monotonic_ns()
            unix = time.time_ns()
            after = time.monotonic_ns()
            reading = (after - before, unix - (before + after) // 2)
            best = reading if best is None else min(best, reading)
        assert best is not None
        return cls(best[1])

    def unix_ns(self, monotonic_ns: int) -> int:
        return monotonic_ns + self.offset_ns

    def step_ns(self, now: "HostTime") -> int:
        """Step of the wall clock since this offset was fixed; 0 if there was none."""
        step = now.offset_ns - self.offset_ns
        return step if abs(step) >= STEP_NS else 0
