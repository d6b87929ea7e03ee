"""Prediction at the velocity of the last matches, without odometry."""

from collections import deque

from service.geometry.se2 import SE2

MIN_STEP_NS, MAX_STEADY_STEP_NS = 20_000_000, 1_000_000_000  # between poses that give a velocity


class SteadyMotion:
    """Prediction at the velocity of the last matches, independent of odometry."""

    def __init__(self) -> None:
        # Stamps and poses; first and last are MIN_STEP_NS apart, because scans of several lasers are close.
        self._matched: deque[tuple[int, SE2]] = deque()

    def matched(self, stamp_ns: int, pose: SE2) -> None:
        """Add a match."""
        self._matched.append((stamp_ns, pose))
        while len(self._matched) > 2 and stamp_ns - self._matched[1][0] >= MIN_STEP_NS:
            self._matched.popleft()

    @property
    def last(self) -> SE2 | None:
        """Pose of the newest match; None: there was none."""
        return self._matched[-1][1] if self._matched else None

    def pose_at(self, stamp_ns: int) -> SE2 | None:
        """The predicted pose; None without a velocity, or for a stamp too far ahead."""
        if len(self._matched) < 2:
            return None
        (before_ns, before), (last_ns, last) = self._matched[0], self._matched[-1]
        step_ns, ahead_ns = last_ns - before_ns, stamp_ns - last_ns
        if not (MIN_STEP_NS <= step_ns <= MAX_STEADY_STEP_NS and 0 < ahead_ns <= MAX_STEADY_STEP_NS):
            return None
        steps = ahead_ns / step_ns
        forward_m, left_m, turn_rad = (before.inverse() @ last).log()
        return last @ SE2.exp(steps * forward_m, steps * left_m, steps * turn_rad)
