"""Where the wheels say the vehicle was: poses between samples, and a little beyond them."""

import math
from bisect import bisect_right
from dataclasses import dataclass

from drivers.frames import OdometrySample
from service.geometry.se2 import SE2, wrap_angle

KEEP_NS = 10_000_000_000  # older samples are dropped
TRIM_COUNT = 4096  # ... once there are so many


@dataclass(frozen=True, slots=True)
class Way:
    """What was driven between two moments."""

    motion: SE2  # pose of the later base in the earlier one
    guessed_s: float  # how much of the time lies beyond the samples


class OdometryTrack:
    """Samples in order of their stamps. Only differences of poses are used, never the twist in a sample:
    recordings carry zeros there, and drivers disagree about its axes.

    max_speed_mps, max_turn_radps    a step faster than this is a restarted driver: the track begins anew
    max_guess_s                      how far beyond the samples a pose is guessed from the last speed
    speed_window_s                   over which that speed is taken, so that encoder ticks average out
    """

    def __init__(
        self, max_speed_mps: float, max_turn_radps: float, max_guess_s: float, speed_window_s: float
    ) -> None:
        self._max_speed_mps = max_speed_mps
        self._max_turn_radps = max_turn_radps
        self._max_guess_s = max_guess_s
        self._speed_window_s = speed_window_s
        self._stamps: list[int] = []
        self._poses: list[SE2] = []
        self.restarts = 0

    def add(self, sample: OdometrySample) -> bool:
        """False where the sample is not newer than the last one, or not a number."""
        if not (math.isfinite(sample.x_m) and math.isfinite(sample.y_m) and math.isfinite(sample.theta_rad)):
            return False
        pose = SE2(sample.x_m, sample.y_m, sample.theta_rad)
        if self._stamps:
            elapsed_s = (sample.stamp_ns - self._stamps[-1]) * 1e-9
            if elapsed_s <= 0.0:
                return False
            step = self._poses[-1].inverse() @ pose
            if (
                math.hypot(step.x_m, step.y_m) > self._max_speed_mps * elapsed_s + 0.1
                or abs(step.theta_rad) > self._max_turn_radps * elapsed_s + 0.1
            ):
                self._stamps.clear()
                self._poses.clear()
                self.restarts += 1
        self._stamps.append(sample.stamp_ns)
        self._poses.append(pose)
        if len(self._stamps) > TRIM_COUNT:
            first = bisect_right(self._stamps, sample.stamp_ns - KEEP_NS)
            first = min(first, len(self._stamps) - 2)
            del self._stamps[:first], self._poses[:first]
        return True

    @property
    def newest_ns(self) -> int | None:
        return self._stamps[-1] if self._stamps else None

    def between(self, from_ns: int, to_ns: int) -> Way | None:
        """The way from one moment to a later one; None where the samples cannot tell."""
        if len(self._stamps) < 2:
            return None
        before_s = max((self._stamps[0] - from_ns) * 1e-9, 0.0)
        after_s = max((to_ns - self._stamps[-1]) * 1e-9, 0.0)
        if before_s > self._max_guess_s or after_s > self._max_guess_s:
            return None
        return Way(self._pose_at(from_ns).inverse() @ self._pose_at(to_ns), before_s + after_s)

    def turn_between(self, from_ns: int, to_ns: int) -> float | None:
        """Angle turned, rad; None unless samples lie at or beyond both ends."""
        if not self._stamps or not self._stamps[0] <= from_ns <= to_ns <= self._stamps[-1]:
            return None
        first, first_rad = self._heading_at(from_ns)
        last, last_rad = self._heading_at(to_ns)
        turned = sum(
            wrap_angle(self._poses[i + 1].theta_rad - self._poses[i].theta_rad) for i in range(first, last)
        )
        return turned + last_rad - first_rad

    def _heading_at(self, stamp_ns: int) -> tuple[int, float]:
        """The last sample not after a moment within the track, and the turn since then, rad."""
        i = min(bisect_right(self._stamps, stamp_ns), len(self._stamps) - 1) - 1
        if i < 0:
            return 0, 0.0
        step = wrap_angle(self._poses[i + 1].theta_rad - self._poses[i].theta_rad)
        share = (stamp_ns - self._stamps[i]) / (self._stamps[i + 1] - self._stamps[i])
        return i, share * step

    def twist_at(self, stamp_ns: int) -> tuple[float, float, float] | None:
        """Speed around a moment (m/s forward, m/s left, rad/s), by the nearest samples; None as above."""
        if len(self._stamps) < 2:
            return None
        last = min(max(bisect_right(self._stamps, stamp_ns), 1), len(self._stamps) - 1)
        window_ns = round(self._speed_window_s * 1e9)
        first = last - 1
        while first > 0 and self._stamps[last] - self._stamps[first] < window_ns:
            first -= 1
        elapsed_s = (self._stamps[last] - self._stamps[first]) * 1e-9
        if (stamp_ns - self._stamps[last]) * 1e-9 > self._max_guess_s:
            return None
        forward, left, turn = (self._poses[first].inverse() @ self._poses[last]).log()
        return forward / elapsed_s, left / elapsed_s, turn / elapsed_s

    def _pose_at(self, stamp_ns: int) -> SE2:
        i = bisect_right(self._stamps, stamp_ns)
        if 0 < i < len(self._stamps):
            earlier, later = self._stamps[i - 1], self._stamps[i]
            share = (stamp_ns - earlier) / (later - earlier)
            forward, left, turn = (self._poses[i - 1].inverse() @ self._poses[i]).log()
            return self._poses[i - 1] @ SE2.exp(share * forward, share * left, share * turn)
        end = 0 if i == 0 else -1
        twist = self.twist_at(self._stamps[end])
        assert twist is not None  # between() has seen two samples
        elapsed_s = (stamp_ns - self._stamps[end]) * 1e-9
        return self._poses[end] @ SE2.exp(*(rate * elapsed_s for rate in twist))
