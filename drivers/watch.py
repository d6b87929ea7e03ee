"""What every session watches for: silence, only malformed messages, stamps that cannot be."""

from collections import Counter

from drivers.errors import ProtocolError

LOOK_NS = 200_000_000  # of the time between two looks no more counts as silence: the host may have stalled


class SilenceWatch:
    """How long a device has sent no usable frame, counted over the time that it was watched.

    Call `look` at every tick, and `heard` for each frame that is handed on; dropped frames do not count.
    """

    def __init__(self) -> None:
        self._looked_at_ns: int | None = None
        self._silent_ns = 0

    def look(self, now_ns: int, waiting: bool) -> None:
        """waiting: the device should be sending; time before it was asked to does not count."""
        if waiting and self._looked_at_ns is not None:
            self._silent_ns += min(now_ns - self._looked_at_ns, LOOK_NS)
        self._looked_at_ns = now_ns

    def heard(self) -> None:
        self._silent_ns = 0

    def exceeds(self, limit_s: float) -> bool:
        return self._silent_ns > limit_s * 1e9


class StampGate:
    """Which frames are handed on: stamped no later than their arrival, and later than the one before.

    Others are counted as `<what>_ahead_of_arrival` and `<what>_out_of_order`.
    """

    def __init__(self, counters: Counter[str], what: str) -> None:
        self._counters = counters
        self._what = what
        self.last_ns: int | None = None  # stamp of the newest frame that passed

    def passes(self, stamp_ns: int, arrived_ns: int) -> bool:
        if stamp_ns > arrived_ns:
            self._counters[f"{self._what}_ahead_of_arrival"] += 1
            return False
        if self.last_ns is not None and stamp_ns <= self.last_ns:
            self._counters[f"{self._what}_out_of_order"] += 1
            return False
        self.last_ns = stamp_ns
        return True


class MalformedRun:
    """Counts malformed messages as `<what>_malformed`, and ends a session where only such come.

    what     plural, as in the counters: scans
    limit    this many in a row are tolerated
    """

    def __init__(self, counters: Counter[str], what: str, limit: int) -> None:
        self._counters = counters
        self._what = what
        self._limit = limit
        self._in_a_row = 0

    def bad(self, error: ProtocolError) -> None:
        """Count one. Raises ProtocolError where there are more than `limit` in a row."""
        self._counters[f"{self._what}_malformed"] += 1
        self._in_a_row += 1
        if self._in_a_row > self._limit:
            raise ProtocolError(f"{self._in_a_row} malformed {self._what} in a row: {error}") from error

    def good(self) -> None:
        self._in_a_row = 0
