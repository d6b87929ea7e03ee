"""Inertia: no vehicle changes its velocity at once; evidence of [35]."""

from collections import deque
from collections.abc import Iterable

import numpy as np

from service.estimator.estimator import EstimatorConfig
from service.estimator.motion import PAUSE_NS
from service.geometry.se2 import SE2
from service.kernels.filter_state import STUDENT
from service.kernels.match import student_cost
from service.mapper.judgement import chi2_between
from service.mapper.scan_match.attempt import Matrix

USUAL = EstimatorConfig()  # process noise of a vehicle and noise of odometry, before learning
MIN_STEP_NS = 20_000_000  # between poses that give a velocity


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
        if step_ns < MIN_STEP_NS or ahead_ns <= 0 or max(step_ns, ahead_ns) > PAUSE_NS:
            return None
        steps = ahead_ns / step_ns
        forward_m, left_m, turn_rad = before.between(last).log()
        return last @ SE2.exp(steps * forward_m, steps * left_m, steps * turn_rad)


def velocity_variance(elapsed_s: float) -> tuple[float, float]:
    """(m^2, rad^2) by which a vehicle may deviate from constant velocity."""
    integrated_s3 = elapsed_s**3 / 3.0
    return USUAL.acceleration**2 * integrated_s3, USUAL.turn_acceleration**2 * integrated_s3


def inertia_cost(constant_velocity: SE2, pose: SE2, elapsed_s: float, covariance: Matrix) -> float:
    """Cost of the change of velocity that a pose requires: half the cost of [12], nats.

    constant_velocity   predicted pose at the velocity before
    elapsed_s           since the pose before
    covariance          (3, 3) of the difference at constant velocity, base axes
    """
    position_m2, turn_rad2 = velocity_variance(elapsed_s)
    chi2 = chi2_between(constant_velocity, pose, covariance + np.diag([position_m2, position_m2, turn_rad2]))
    cost: float = student_cost(chi2, STUDENT)
    return cost


def largest_inertia_cost(path: Iterable[tuple[int, SE2, Matrix]]) -> float:
    """Largest cost of a change of velocity along a path, nats; 0 for fewer than three poses.

    path   stamp, pose and covariance (3, 3) of the step to it, base axes
    """
    steady, largest, last_ns = SteadyMotion(), 0.0, 0
    for stamp_ns, pose, covariance in path:
        expected = steady.pose_at(stamp_ns)
        if expected is not None:  # twice the covariance: the step before is as uncertain
            cost = inertia_cost(expected, pose, (stamp_ns - last_ns) * 1e-9, 2.0 * covariance)
            largest = max(largest, cost)
        steady.matched(stamp_ns, pose)
        last_ns = stamp_ns
    return largest
