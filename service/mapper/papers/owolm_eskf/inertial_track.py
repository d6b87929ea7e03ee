"""Samples of an IMU in the order of their stamps, as steps of constant rate and force."""

import itertools
import math
from bisect import bisect_left, bisect_right
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from drivers.frames import ImuSample

Vector = npt.NDArray[np.float64]  # (3,)
Step = tuple[float, Vector, Vector]  # s; specific force, m/s^2, and rate, rad/s, in base axes
TRIM_COUNT = 8192


class InertialTrack:
    """Samples of an IMU whose x axis is rotated by yaw_rad against the base's; kept until used.

    max_hold_s   for which a sample replaces missing ones behind it
    """

    def __init__(self, yaw_rad: float, max_hold_s: float) -> None:
        c, s = math.cos(yaw_rad), math.sin(yaw_rad)
        self._base_from_sensor = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        self._max_hold_ns = round(max_hold_s * 1e9)
        self._stamps: list[int] = []
        self._samples: list[tuple[Vector, Vector]] = []
        self._used_ns: int | None = None

    def add(self, sample: ImuSample) -> bool:
        """Add a sample, in any order after the last used stamp.

        False if it was dropped: too late, of a known stamp, or not finite.
        """
        felt = np.array([*sample.force_mps2, *sample.rate_radps])
        if not np.isfinite(felt).all() or (self._used_ns is not None and sample.stamp_ns <= self._used_ns):
            return False
        place = bisect_left(self._stamps, sample.stamp_ns)
        if place < len(self._stamps) and self._stamps[place] == sample.stamp_ns:
            return False
        turn = self._base_from_sensor
        self._stamps.insert(place, sample.stamp_ns)
        self._samples.insert(place, (turn @ felt[:3], turn @ felt[3:]))
        if len(self._stamps) > TRIM_COUNT:  # no scans arrive
            del self._stamps[: TRIM_COUNT // 2], self._samples[: TRIM_COUNT // 2]
        return True

    def covers(self, from_ns: int, to_ns: int) -> bool:
        """Whether no time is more than max_hold_s behind a sample."""
        first = bisect_right(self._stamps, from_ns) - 1
        last = bisect_right(self._stamps, to_ns)
        if last == 0 or (first < 0 and self._stamps[0] - from_ns > self._max_hold_ns):
            return False
        edges = [*self._stamps[max(first, 0) : last], to_ns]
        return all(b - a <= self._max_hold_ns for a, b in itertools.pairwise(edges))

    def steps(self, from_ns: int, to_ns: int) -> Iterator[Step]:
        """Steps between samples, with the mean of both ends; requires covers()."""
        inside = range(bisect_right(self._stamps, from_ns), bisect_left(self._stamps, to_ns))
        edges = [from_ns, *(self._stamps[k] for k in inside), to_ns]
        for begin_ns, end_ns in itertools.pairwise(edges):
            if end_ns <= begin_ns:
                continue
            (force_0, rate_0), (force_1, rate_1) = self._at(begin_ns), self._at(end_ns)
            yield (end_ns - begin_ns) * 1e-9, 0.5 * (force_0 + force_1), 0.5 * (rate_0 + rate_1)

    def rate_at(self, stamp_ns: int) -> Vector:
        return self._at(stamp_ns)[1]

    def before(self, stamp_ns: int) -> tuple[list[int], npt.NDArray[np.float64]]:
        """Stamps up to a time, and (N, 6) forces and rates."""
        count = bisect_right(self._stamps, stamp_ns)
        felt = np.array([np.concatenate(sample) for sample in self._samples[:count]])
        return self._stamps[:count], felt.reshape(-1, 6)

    def use_up(self, stamp_ns: int) -> None:
        """Drop the samples before a time, except the last."""
        first = max(bisect_right(self._stamps, stamp_ns) - 1, 0)
        del self._stamps[:first], self._samples[:first]
        self._used_ns = stamp_ns

    def _at(self, stamp_ns: int) -> tuple[Vector, Vector]:
        """Interpolated linearly between two samples, constant outside."""
        k = bisect_right(self._stamps, stamp_ns)
        if k == 0 or k == len(self._stamps):
            return self._samples[min(k, len(self._samples) - 1)]
        begin_ns, end_ns = self._stamps[k - 1], self._stamps[k]
        share = (stamp_ns - begin_ns) / (end_ns - begin_ns)
        (force_0, rate_0), (force_1, rate_1) = self._samples[k - 1], self._samples[k]
        return force_0 + share * (force_1 - force_0), rate_0 + share * (rate_1 - rate_0)
