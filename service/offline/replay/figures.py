"""Figures of a replay: how long scans took, and how much memory."""

import time
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np


class ComponentTimes:
    """Stopwatch of the mapper's components."""

    def __init__(self) -> None:
        self.laps_ns: defaultdict[str, list[int]] = defaultdict(list)
        self._at_ns = 0

    def start(self) -> None:
        self._at_ns = time.perf_counter_ns()

    def lap(self, component: str) -> None:
        now_ns = time.perf_counter_ns()
        self.laps_ns[component].append(now_ns - self._at_ns)
        self._at_ns = now_ns

    def p50_ms(self) -> dict[str, float]:
        return {component: round(float(np.median(laps)) / 1e6, 3) for component, laps in self.laps_ns.items()}


def percentiles_ms(durations_ns: Sequence[int]) -> dict[str, float]:
    p50, p95, p99 = np.percentile(durations_ns, (50, 95, 99)) / 1e6
    largest = max(durations_ns) / 1e6
    return {"p50": round(p50, 3), "p95": round(p95, 3), "p99": round(p99, 3), "max": round(largest, 3)}


def peak_rss_mb() -> int:
    """Peak memory of this process alone; getrusage would count the memory of a parent before exec."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    kilobytes = next(line.split()[1] for line in status.splitlines() if line.startswith("VmHWM:"))
    return round(int(kilobytes) / 1024)
