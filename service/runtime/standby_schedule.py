"""Time of the mapper's next stand-by: in a pause between scans that is long enough for a fork."""

from collections import deque

INTERVAL_NS = 4_000_000_000  # from one stand-by to the next, while items come
URGENT_NS = 500_000_000  # to the next where the newest is gone: one that dies at once costs a fork each time
OVERDUE_NS = 12_000_000_000  # since the last one: then one is made though items wait, or a scan is due
ARRIVALS = 9  # of each laser: the median of the eight times between them is its period
MAX_PERIODS = 3  # without a scan; then a laser is silent, and nothing is expected of it


class ScanForecast:
    """Forecast of the next scan. Host monotonic ns; `arrived` with each scan, in order; then `pause_ns`."""

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


class StandbySchedule:
    """Host monotonic ns throughout. `arrived` with each scan, `made` with each stand-by."""

    def __init__(self) -> None:
        self._forecast = ScanForecast()
        self._made_ns = -OVERDUE_NS
        self._is_urgent = True
        self._took_ns = 0  # the newest fork; the next one takes about as long

    def arrived(self, sensor: str, at_ns: int) -> None:
        """The last byte of a scan of this laser was read."""
        self._forecast.arrived(sensor, at_ns)

    def made(self, began_ns: int, took_ns: int) -> None:
        """A stand-by was forked."""
        self._made_ns, self._took_ns = began_ns, took_ns
        self._is_urgent = False

    def make_next_at_once(self) -> None:
        """The newest stand-by has ended, or is out of date."""
        self._is_urgent = True

    def is_due(self, now_ns: int, is_waiting: bool) -> bool:
        """Whether to fork now.

        is_waiting   items wait to be mapped
        """
        age_ns = now_ns - self._made_ns
        if age_ns >= (URGENT_NS if self._is_urgent else OVERDUE_NS):
            return True
        if age_ns < INTERVAL_NS:
            return False
        pause_ns = self._forecast.pause_ns(now_ns)
        return not is_waiting and (pause_ns is None or pause_ns >= self._took_ns)
