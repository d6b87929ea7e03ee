"""How far the vehicle turned, from the yaw rate of an IMU whose z axis points up."""

import math
from bisect import bisect_right

from drivers.frames import ImuSample

KEEP_NS = 10_000_000_000
TRIM_COUNT = 8192


class GyroTrack:
    """Yaw rates in order of their stamps, each held until the next, less a bias that is learnt from matches.

    max_hold_s         how long a rate is held beyond the last sample
    bias_time_s        time constant of the learning
    max_bias_radps     a larger one is a fault, not a bias, and is not followed
    """

    def __init__(self, max_hold_s: float, bias_time_s: float, max_bias_radps: float) -> None:
        self._max_hold_s = max_hold_s
        self._bias_time_s = bias_time_s
        self._max_bias_radps = max_bias_radps
        self._stamps: list[int] = []
        self._rates: list[float] = []
        self.bias_radps = 0.0

    def add(self, sample: ImuSample) -> bool:
        """False where the sample is not newer than the last one, or not a number."""
        rate = sample.rate_radps[2]
        if not math.isfinite(rate) or (self._stamps and sample.stamp_ns <= self._stamps[-1]):
            return False
        self._stamps.append(sample.stamp_ns)
        self._rates.append(rate)
        if len(self._stamps) > TRIM_COUNT:
            first = min(bisect_right(self._stamps, sample.stamp_ns - KEEP_NS), len(self._stamps) - 1)
            del self._stamps[:first], self._rates[:first]
        return True

    def turn_between(self, from_ns: int, to_ns: int) -> float | None:
        """Angle turned, rad; None where samples are missing for longer than max_hold_s."""
        if not self._stamps or self._stamps[0] > from_ns:
            return None
        first = bisect_right(self._stamps, from_ns) - 1
        turn_rad = 0.0
        at_ns = from_ns
        for i in range(first, len(self._stamps)):
            until_ns = min(self._stamps[i + 1], to_ns) if i + 1 < len(self._stamps) else to_ns
            if (until_ns - self._stamps[i]) * 1e-9 > self._max_hold_s:
                return None
            turn_rad += (self._rates[i] - self.bias_radps) * (until_ns - at_ns) * 1e-9
            at_ns = until_ns
            if at_ns >= to_ns:
                break
        return turn_rad

    def rate_at(self, stamp_ns: int) -> float | None:
        """Yaw rate, rad/s; None as above."""
        i = bisect_right(self._stamps, stamp_ns) - 1
        if i < 0 or (stamp_ns - self._stamps[i]) * 1e-9 > self._max_hold_s:
            return None
        return self._rates[i] - self.bias_radps

    def learn_bias(self, from_ns: int, to_ns: int, matched_turn_rad: float) -> None:
        """Move the bias towards what makes the rates agree with a match."""
        turn_rad = self.turn_between(from_ns, to_ns)
        elapsed_s = (to_ns - from_ns) * 1e-9
        if turn_rad is None or not 0.0 < elapsed_s < 1.0:
            return
        error_radps = (turn_rad - matched_turn_rad) / elapsed_s
        bias = self.bias_radps + error_radps * min(elapsed_s / self._bias_time_s, 1.0)
        self.bias_radps = min(max(bias, -self._max_bias_radps), self._max_bias_radps)
