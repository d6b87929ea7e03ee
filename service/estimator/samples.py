"""Samples of a motion source that wait for scans."""

from dataclasses import dataclass, field

import numpy as np

from service.estimator.motion import PAUSE_NS
from service.kernels.tracks import Track

CAPACITY = 4096
MAX_SAMPLES = 200_000  # waiting for a scan; above, all between oldest and newest quarter are dropped
DROPPED_TOGETHER = 64  # samples: a search for the oldest that is needed costs as much as a step


@dataclass(slots=True)
class Samples:
    """A growing Track; samples before the last scan are dropped."""

    width: int
    track: Track = field(init=False)
    dropped: int = 0  # since the last prediction, because too many waited

    def __post_init__(self) -> None:
        self.track = Track(
            np.zeros(CAPACITY, np.int64), np.zeros((CAPACITY, self.width)), np.zeros(2, np.int64)
        )

    @property
    def last(self) -> int | None:
        """Row of the newest sample; None: empty."""
        first, end = self.track.span.tolist()
        return end - 1 if end > first else None

    def longest_pause_s(self, since_ns: int, until_ns: int) -> float:
        """Longest time without a sample between two times, s; 0 where it is at most PAUSE_NS."""
        first, end = self.track.span.tolist()
        stamps = np.clip(self.track.stamp_ns[first:end], since_ns, until_ns)
        longest_ns = int(np.diff(np.r_[since_ns, stamps, until_ns]).max())
        return longest_ns * 1e-9 if longest_ns > PAUSE_NS else 0.0

    def covered_ns(self, since_ns: int, until_ns: int) -> int:
        """Part of an interval covered by samples, from the first sample in or after it, ns."""
        first, end = self.track.span.tolist()
        row = first + int(np.searchsorted(self.track.stamp_ns[first:end], since_ns))
        if row == end:
            return 0
        return max(min(until_ns, int(self.track.stamp_ns[end - 1])) - int(self.track.stamp_ns[row]), 0)

    def append(self, stamp_ns: int, value: tuple[float, ...]) -> None:
        end = int(self.track.span[1])
        if end == len(self.track.stamp_ns):
            self._make_room()
            end = int(self.track.span[1])
        self.track.stamp_ns[end] = stamp_ns
        self.track.value[end] = value
        self.track.span[1] = end + 1

    def clear(self) -> None:
        """Drop all samples."""
        self.track.span[0] = self.track.span[1]

    def drop_before(self, stamp_ns: int) -> None:
        """Drop the samples before a time, except two for a speed; few of them later, with others."""
        first, end = self.track.span.tolist()
        if end - first <= DROPPED_TOGETHER or self.track.stamp_ns[first + DROPPED_TOGETHER] >= stamp_ns:
            return
        self.track.span[0] = first + int(self.track.stamp_ns[first:end].searchsorted(stamp_ns)) - 2

    def _make_room(self) -> None:
        first, end = self.track.span.tolist()
        old = self.track
        if end - first >= MAX_SAMPLES:  # the laser may be silent for a day
            rows = np.r_[first : first + MAX_SAMPLES // 4, end - MAX_SAMPLES // 4 : end]
            old = Track(old.stamp_ns[rows], old.value[rows], np.array([0, len(rows)]))
            self.dropped += end - first - len(rows)
            first, end = 0, len(rows)
        size = len(old.stamp_ns) if first > len(old.stamp_ns) // 2 else 2 * len(old.stamp_ns)
        self.track = Track(np.zeros(size, np.int64), np.zeros((size, self.width)), np.array([0, end - first]))
        self.track.stamp_ns[: end - first] = old.stamp_ns[first:end]
        self.track.value[: end - first] = old.value[first:end]
