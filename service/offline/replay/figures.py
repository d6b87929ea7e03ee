"""Figures of a replay for its summary: times, memory, rates of sensors, why scans were not ok, warnings."""

import logging
import threading
import time
from array import array
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drivers.counted import counted
from drivers.frames import Frame
from service.mapper.components import Stopwatch
from service.outputs import MapperOutput
from service.timing.timing import KINDS
from service.timing.words import kind_of

LOGGER = logging.getLogger("service")
GAP_PERIODS = 3.0  # of the usual one: a longer interval is a gap
MAX_GAPS = 50  # that are listed of each, the longest
STATES = ("degraded", "lost")
MAX_KINDS = 5  # of reasons, of each state


class ComponentTimes(Stopwatch):
    """Times of the mapper's components."""

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


class SensorRates:
    """Takes the frames of a recording, in any order."""

    def __init__(self) -> None:
        self._stamps_ns: defaultdict[str, array[int]] = defaultdict(lambda: array("q"))

    def add(self, frame: Frame) -> None:
        self._stamps_ns[f"{frame.sensor}/{KINDS[type(frame)]}"].append(frame.stamp_ns)

    def as_dict(self, begin_ns: int) -> dict[str, dict[str, Any]]:
        """ "front/scan" -> its "frames", "rate_hz" (by the median period; None of a single stamp), "gaps"
        (how many intervals have more than GAP_PERIODS of these) and "longest_gaps", in the order of time:
        [begin in s since begin_ns, length in s] each.
        """
        return {name: _gaps(np.array(stamps), begin_ns) for name, stamps in sorted(self._stamps_ns.items())}


def _gaps(stamps_ns: np.ndarray, begin_ns: int) -> dict[str, Any]:
    at_ns = np.unique(stamps_ns)
    facts: dict[str, Any] = {"frames": len(stamps_ns), "rate_hz": None, "gaps": 0, "longest_gaps": []}
    if len(at_ns) < 2:
        return facts
    interval_ns = np.diff(at_ns)
    period_ns = float(np.median(interval_ns))
    gaps = np.flatnonzero(interval_ns > GAP_PERIODS * period_ns)
    longest = np.sort(gaps[np.argsort(-interval_ns[gaps], kind="stable")][:MAX_GAPS])
    return facts | {
        "rate_hz": round(1e9 / period_ns, 3),
        "gaps": len(gaps),
        "longest_gaps": [
            [round(int(at_ns[k] - begin_ns) / 1e9, 3), round(int(interval_ns[k]) / 1e9, 3)]
            for k in longest.tolist()
        ],
    }


class StateReasons:
    """Counts the reasons of outputs; those that differ in their numbers alone are of one kind."""

    def __init__(self) -> None:
        self._begin_ns: int | None = None
        self._kinds: dict[tuple[str, str], dict[str, Any]] = {}  # by state and reason without its numbers

    def add(self, output: MapperOutput) -> None:
        """The next one, whatever its state."""
        if self._begin_ns is None:
            self._begin_ns = output.stamp_ns
        if output.state not in STATES:
            return
        kind = output.state, kind_of(output.reason)
        if kind not in self._kinds:
            first_s = round((output.stamp_ns - self._begin_ns) / 1e9, 3)
            self._kinds[kind] = {
                "id": output.reason.id,
                "reason": str(output.reason),
                "scans": 0,
                "first_s": first_s,
            }
        self._kinds[kind]["scans"] += 1

    def as_dict(self) -> dict[str, list[dict[str, Any]]]:
        """State -> its most frequent kinds: id of the reason, the first reason, how many scans it has, and
        when it came first, in s after the first scan.
        """
        kinds = sorted(self._kinds.items(), key=lambda kind: -kind[1]["scans"])
        return {state: [facts for (of, _), facts in kinds if of == state][:MAX_KINDS] for state in STATES}


def doubts(summary: Mapping[str, Any]) -> Iterator[str]:
    """A line for each state but ok: how many of the scans are in it, and mostly why."""
    for state, kinds in summary["state_reasons"].items():
        for main in kinds[:1]:
            count = summary["state"][state]
            yield (
                f"{count} of {counted(summary['scans'], 'scan')} {'was' if count == 1 else 'were'} {state}; "
                f"{main['scans']} of them, from {main['first_s']:.1f} s on: {main['reason']}"
            )


class Warned(logging.Handler):
    """Inside of `with`, collects what the service logs as a warning or worse in this thread.

    Lines that differ in their numbers alone are one, in the words of the first.
    """

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self._kinds: dict[str, str] = {}
        self._thread = threading.get_ident()

    def __enter__(self) -> "Warned":
        LOGGER.addHandler(self)
        return self

    def __exit__(self, *exception: object) -> None:
        LOGGER.removeHandler(self)

    @property
    def lines(self) -> list[str]:
        """In the order in which they came."""
        return list(self._kinds.values())

    def emit(self, record: logging.LogRecord) -> None:
        if record.thread == self._thread:
            line = record.getMessage()
            self._kinds.setdefault(kind_of(line), line)
