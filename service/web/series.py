"""Figures over time, a row for each second: what the area History of the page draws.

speed_mps         forward, of the newest pose of the second
sigma_m           largest standard deviation of the position, of the least certain pose of the second
inlier_ratio      0 to 1, of the newest health, as in its status `mapping`
latency_p50_ms    from a scan to its pose; see FigureRows.put_latencies
latency_max_ms
mapped_hz         scans mapped a second
dropped           scans not mapped, since the row before
rate_hz/SENSOR    frames a second
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from statistics import median

from service.encoding import Pose, Status

PERIOD_S = 1.0  # also of health
EARLY_S = 0.25  # health comes about so much before its second is over
MAX_ROWS = 2000  # of a complete recording; those of a long one are of more than a second each
BACK_S = 5.0  # a clock that was set: rows that much older than the newest belong to another run


@dataclass(frozen=True, slots=True)
class Row:
    """state, level    of the status `mapping`; "" and 0 where no health came."""

    stamp_s: float  # Unix time
    state: str
    level: int
    figures: Mapping[str, float]  # those that are known


@dataclass(slots=True)
class FigureRows:
    """Takes poses, latencies and health, and makes a row of what came in each `period_s`."""

    period_s: float = PERIOD_S
    _begin_s: float | None = None  # of the row that is being filled
    _state: str = ""
    _level: int = 0
    _has_health: bool = False  # since the last row
    _figures: dict[str, float] = field(default_factory=dict)  # since the last row
    _latencies_ms: list[float] = field(default_factory=list)
    _dropped: float | None = None  # in all, at the last row
    _dropped_now: float | None = None

    def put_pose(self, pose: Pose) -> None:
        (xx, xy), (_, yy) = pose.covariance[:2, :2].tolist()
        sigma_m = math.sqrt(max((xx + yy) / 2 + math.hypot((xx - yy) / 2, xy), 0.0))
        self._figures["sigma_m"] = max(self._figures.get("sigma_m", 0.0), sigma_m)
        self._figures["speed_mps"] = pose.twist[0]

    def put_latencies(self, ms: Iterable[float]) -> None:
        """Of a running service from the last byte of a scan to its pose; of a recording from the stamp of a
        scan, its first beam, to the log time of its pose."""
        self._latencies_ms.extend(ms)

    def put_health(self, statuses: Sequence[Status]) -> None:
        """Take the state of health; of several in one row the worst remains."""
        for status in statuses:
            kind, _, sensor = status.name.partition("/")
            if kind == "sensor" and (rate_hz := _number(status, "rate_hz")) is not None:
                self._figures[f"rate_hz/{sensor}"] = rate_hz
            elif status.name == "mapping":
                self._put_mapping(status)

    def row(self, now_s: float) -> Row | None:
        """A row, once `period_s` are over and health has come, or two periods without; None before,
        and while nothing is known."""
        if self._begin_s is None or now_s < self._begin_s - BACK_S:
            self._begin_s = now_s
        due_s = self._begin_s + (self.period_s - EARLY_S if self._has_health else 2 * self.period_s)
        if now_s < due_s:
            return None
        if self._latencies_ms:
            self._figures["latency_p50_ms"] = median(self._latencies_ms)
            self._figures["latency_max_ms"] = max(self._latencies_ms)
        if self._dropped_now is not None:
            before = self._dropped if self._dropped is not None else self._dropped_now
            self._figures["dropped"] = max(self._dropped_now - before, 0.0)  # a new run counts from 0
            self._dropped = self._dropped_now
        is_known = bool(self._figures or self._state)
        row = Row(now_s, self._state, self._level, self._figures)
        self._figures, self._latencies_ms, self._dropped_now = {}, [], None
        self._begin_s, self._has_health = now_s, False
        return row if is_known else None

    def _put_mapping(self, status: Status) -> None:
        for name, key in (("inlier_ratio", "inlier_ratio"), ("mapped_hz", "scan_rate_hz")):
            if (value := _number(status, key)) is not None:
                self._figures[name] = value
        self._dropped_now = _number(status, "scans_dropped")
        if not self._has_health or status.level >= self._level:
            self._state, self._level = status.values.get("state", ""), status.level
        self._has_health = True


def _number(status: Status, key: str) -> float | None:
    try:
        value = float(status.values.get(key, ""))
    except ValueError:
        return None
    return value if math.isfinite(value) else None
