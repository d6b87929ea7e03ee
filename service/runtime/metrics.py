"""Latencies and rates in bounded memory, over days."""

import math
import threading
from dataclasses import dataclass

_SMALLEST_NS = 1_000.0
_GROWTH = 1.02  # a bucket is 2 % wide, so a percentile is good to 1 %
_LOG_GROWTH = math.log(_GROWTH)
_BUCKETS = math.ceil(math.log(1e12 / _SMALLEST_NS) / _LOG_GROWTH)  # up to 1000 s

MIN_INTERVAL_NS = 500_000_000  # of a rate: one event more or less then changes it little


@dataclass(frozen=True, slots=True)
class Percentiles:
    """Percentiles of durations, ms. All 0 where nothing was measured."""

    p50: float
    p95: float
    p99: float
    max: float

    def as_dict(self) -> dict[str, float]:
        return {"p50": self.p50, "p95": self.p95, "p99": self.p99, "max": self.max}


class LatencyHistogram:
    """Durations in buckets of equal ratio. Any thread may add, any may read."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts = [0] * (_BUCKETS + 1)
        self._max_ns = 0
        self.count = 0

    def add(self, duration_ns: int) -> None:
        bucket = 0
        if duration_ns > _SMALLEST_NS:
            bucket = min(int(math.log(duration_ns / _SMALLEST_NS) / _LOG_GROWTH), _BUCKETS)
        with self._lock:
            self._counts[bucket] += 1
            self._max_ns = max(self._max_ns, duration_ns)
            self.count += 1

    def percentiles(self) -> Percentiles:
        with self._lock:
            counts, count, max_ns = list(self._counts), self.count, self._max_ns
        if count == 0:
            return Percentiles(0.0, 0.0, 0.0, 0.0)
        p50, p95, p99 = (_quantile_ns(counts, count, share) for share in (0.50, 0.95, 0.99))
        to_ms = [round(min(ns, max_ns) / 1e6, 3) for ns in (p50, p95, p99, max_ns)]
        return Percentiles(*to_ms)


def _quantile_ns(counts: list[int], count: int, share: float) -> float:
    """Middle of the bucket that holds the smallest value with at least `share` of all at or below it."""
    rank = math.ceil(share * count)
    seen = 0
    for bucket, in_bucket in enumerate(counts):
        seen += in_bucket
        if seen >= rank:
            return _SMALLEST_NS * math.exp(_LOG_GROWTH * (bucket + 0.5))
    raise AssertionError("the counts do not add up")


class RateMeter:
    """Events a second between two readings of a counter."""

    def __init__(self) -> None:
        self._last: tuple[int, int] | None = None
        self.rate_hz = 0.0

    def read(self, count: int, now_ns: int) -> float:
        """Take in that `count` events had happened by now_ns; the rate since the last call, or the one
        before where that is too short ago.
        """
        if self._last is not None:
            if now_ns - self._last[1] < MIN_INTERVAL_NS:
                return self.rate_hz
            self.rate_hz = (count - self._last[0]) * 1e9 / (now_ns - self._last[1])
        self._last = (count, now_ns)
        return self.rate_hz
