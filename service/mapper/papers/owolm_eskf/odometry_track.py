"""Poses by odometry, interpolated between samples and extrapolated briefly."""

import math
from bisect import bisect_right

from drivers.frames import OdometrySample
from service.geometry.se2 import SE2

KEEP_NS = 10_000_000_000  # of samples before the last scan, and before the newest
TRIM_COUNT = 4096  # samples that may wait for a scan; above it those between are dropped
MIN_SPEED_S = 0.005  # closer samples give no speed


class OdometryTrack:
    """Samples in the order of their stamps.

    Only differences of poses are used, not the twist of a sample: recordings have zeros there, and drivers
    disagree about its axes. Stamps may come in bursts, so a speed is taken over a time window.

    max_guess_s       longest extrapolation at the last speed
    speed_window_s    of that speed, so that encoder ticks average out
    """

    def __init__(self, max_guess_s: float, speed_window_s: float) -> None:
        self._max_guess_s = max_guess_s
        self._speed_window_ns = round(speed_window_s * 1e9)
        self._stamps: list[int] = []
        self._poses: list[SE2] = []
        self._used_ns: int | None = None

    def add(self, sample: OdometrySample) -> bool:
        """Add a sample; False if it is not newer than the last one, or not finite."""
        if not (math.isfinite(sample.x_m) and math.isfinite(sample.y_m) and math.isfinite(sample.theta_rad)):
            return False
        if self._stamps and sample.stamp_ns <= self._stamps[-1]:
            return False
        self._stamps.append(sample.stamp_ns)
        self._poses.append(SE2(sample.x_m, sample.y_m, sample.theta_rad))
        if len(self._stamps) > TRIM_COUNT:
            self._drop_between()
        return True

    def use_up(self, stamp_ns: int) -> None:
        """Steps begin at this time or later from now on."""
        self._used_ns = stamp_ns
        first = min(bisect_right(self._stamps, stamp_ns - KEEP_NS) - 1, len(self._stamps) - 2)
        self._drop(0, max(first, 0))

    def between(self, from_ns: int, to_ns: int) -> SE2 | None:
        """Pose of the later base in the earlier one; None outside the samples."""
        if len(self._stamps) < 2:
            return None
        before_s = max((self._stamps[0] - from_ns) * 1e-9, 0.0)
        after_s = max((to_ns - self._stamps[-1]) * 1e-9, 0.0)
        if before_s > self._max_guess_s or after_s > self._max_guess_s:
            return None
        return self._pose_at(from_ns).inverse() @ self._pose_at(to_ns)

    def twist_at(self, stamp_ns: int) -> tuple[float, float, float] | None:
        """Speed at a time (m/s forward, m/s left, rad/s), by the nearest samples; None as above."""
        if len(self._stamps) < 2:
            return None
        last = min(max(bisect_right(self._stamps, stamp_ns), 1), len(self._stamps) - 1)
        if (stamp_ns - self._stamps[last]) * 1e-9 > self._max_guess_s:
            return None
        stamps, window_ns = self._stamps, self._speed_window_ns
        first = last - 1
        while first > 0 and stamps[last] - stamps[first] < window_ns:
            first -= 1
        while last < len(stamps) - 1 and stamps[last] - stamps[first] < window_ns:
            last += 1
        elapsed_s = (stamps[last] - stamps[first]) * 1e-9
        if elapsed_s < MIN_SPEED_S:
            return None
        forward, left, turn = self._poses[first].between(self._poses[last]).log()
        return forward / elapsed_s, left / elapsed_s, turn / elapsed_s

    def _drop_between(self) -> None:
        """Drop the samples that no step needs: the laser may be silent for a day."""
        first = 0 if self._used_ns is None else bisect_right(self._stamps, self._used_ns + KEEP_NS)
        self._drop(first, max(bisect_right(self._stamps, self._stamps[-1] - KEEP_NS) - 1, first))

    def _drop(self, first: int, end: int) -> None:
        del self._stamps[first:end], self._poses[first:end]

    def _pose_at(self, stamp_ns: int) -> SE2:
        i = bisect_right(self._stamps, stamp_ns)
        if 0 < i < len(self._stamps):
            earlier, later = self._stamps[i - 1], self._stamps[i]
            share = (stamp_ns - earlier) / (later - earlier)
            forward, left, turn = self._poses[i - 1].between(self._poses[i]).log()
            return self._poses[i - 1] @ SE2.exp(share * forward, share * left, share * turn)
        end = 0 if i == 0 else -1
        twist = self.twist_at(self._stamps[end]) or (0.0, 0.0, 0.0)
        elapsed_s = (stamp_ns - self._stamps[end]) * 1e-9
        return self._poses[end] @ SE2.exp(*(rate * elapsed_s for rate in twist))
