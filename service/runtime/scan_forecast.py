"""When the next scan is due, so that what takes milliseconds is done in the longest pause between scans."""

from collections import deque

ARRIVALS = 9  # of each laser: the median of the eight times between them is its period
MAX_PERIODS = 3  # without a scan; then a laser is silent, and nothing is expected of it


class ScanForecast:
    """Host monotonic ns throughout. `arrived` with each scan, in order; then `pause_ns`."""

    def __init__(self) -> None:
        self._arrived_ns: dict[str, deque[int]] = {}

    def arrived(self, sensor: str, at_ns: int) -> None:
        """The last byte of a scan of this laser was read."""
        self._arrived_ns.setdefault(sensor, deque(maxlen=ARRIVALS)).append(at_ns)

    def pause_ns(self, now_ns: int) -> int | None:
        """From now to the next scan; 0 where one is overdue, None where no laser is known to send."""
        pauses_ns = []
        for arrivals in self._arrived_ns.values():
            if len(arrivals) < 2:
                continue
            times_ns = sorted(b - a for a, b in zip(arrivals, list(arrivals)[1:], strict=False))
            period_ns = times_ns[len(times_ns) // 2]
            silent_ns = now_ns - arrivals[-1]
            if silent_ns <= MAX_PERIODS * period_ns:
                pauses_ns.append(max(period_ns - silent_ns, 0))
        return min(pauses_ns, default=None)
