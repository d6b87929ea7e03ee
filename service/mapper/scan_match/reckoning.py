"""The path by odometry and gyro, compared with the matched one, and inertia; conflicts of [35]."""

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from service.estimator.estimator import EstimatorConfig
from service.estimator.motion import PAUSE_NS, OdometryIncrement, Prediction
from service.geometry.chi2 import CHI2_999_OF_1, CHI2_999_OF_3
from service.geometry.se2 import SE2, wrap_angle
from service.kernels.filter_state import STUDENT
from service.kernels.increments import MAX_SILENT_S
from service.kernels.match import student_cost
from service.mapper.judgement import chi2_between
from service.mapper.scan_match.attempt import Matrix

USUAL = EstimatorConfig()  # process noise of a vehicle and noise of odometry, before learning
MIN_STEP_NS = 20_000_000  # between poses that give a velocity
# Over which both paths are compared, whichever is shorter; a window without moving returns is static again.
WINDOW_NS, PATH_WINDOW_M = 1_000_000_000, 0.5
MATCH_SIGMA_M, MATCH_SIGMA_RAD = 0.005, 0.003  # of the ends of the matched path
MATCH_COVARIANCE = np.diag([MATCH_SIGMA_M**2, MATCH_SIGMA_M**2, MATCH_SIGMA_RAD**2])  # (3, 3), base axes


class _Step(NamedTuple):
    """Both paths at one scan."""

    stamp_ns: int
    reckoned: SE2  # by odometry and gyro
    matched: SE2
    variance_m2: float  # of `reckoned`, accumulated
    variance_rad2: float
    end_m2: float  # as in OdometryIncrement
    end_rad2: float
    travel_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Conflict:
    """Pose by odometry and gyro that contradicts the matched one; covariance (3, 3), base axes."""

    pose: SE2
    covariance: Matrix
    is_turned: bool  # the headings differ by more than 99.9 % of their noise


class Reckoning:
    """The path by odometry and gyro, compared with the matched one."""

    def __init__(self) -> None:
        self._steps: deque[_Step] = deque()
        self._silent_s = math.inf  # since odometry measured a step
        self.is_silent = True  # odometry does not measure the motion

    def restart(self, stamp_ns: int, matched: SE2) -> None:
        """Start the comparison here."""
        self._steps.clear()
        self._steps.append(_Step(stamp_ns, SE2(), matched, 0.0, 0.0, 0.0, 0.0, 0.0))

    def clear(self) -> None:
        self._steps.clear()

    def add(self, stamp_ns: int, predicted: Prediction, matched: SE2) -> Conflict | None:
        """Add a scan and its matched pose; returns the conflict where the two paths disagree."""
        self._silent_s = self._silent_s + predicted.elapsed_s if predicted.increment is None else 0.0
        self.is_silent = self._silent_s > MAX_SILENT_S
        if self.is_silent or not self._steps:
            self.restart(stamp_ns, matched)
            return None
        steps, step = self._steps, predicted.increment or by_speed(predicted)
        if steps[-1].stamp_ns == stamp_ns:  # the same scan, matched again
            steps[-1] = steps[-1]._replace(matched=matched)
            return _conflict(steps[0], steps[-1])
        last = steps[-1]
        newest = _Step(
            stamp_ns,
            last.reckoned @ step.pose,
            matched,
            last.variance_m2 + step.variance_m2,
            last.variance_rad2 + step.variance_rad2,
            step.end_m2,
            step.end_rad2,
            last.travel_m + math.hypot(step.pose.x_m, step.pose.y_m),
        )
        steps.append(newest)
        while len(steps) > 2 and (
            stamp_ns - steps[1].stamp_ns > WINDOW_NS or newest.travel_m - steps[1].travel_m > PATH_WINDOW_M
        ):
            steps.popleft()
        return _conflict(steps[0], newest)

    def inertia_costs(self) -> tuple[float, float]:
        """Largest costs of a change of velocity before the newest step, nats: by odometry, by matches."""
        steps = list(self._steps)[:-1]
        reckoned = (
            (end.stamp_ns, end.reckoned, _covariance_between(begin, end))
            for begin, end in pairwise(steps[:1] + steps)
        )
        matched = ((step.stamp_ns, step.matched, MATCH_COVARIANCE) for step in steps)
        return largest_inertia_cost(reckoned), largest_inertia_cost(matched)


def by_speed(predicted: Prediction) -> OdometryIncrement:
    """A step at constant velocity: between scans of two lasers there may be no sample of odometry."""
    elapsed_s = predicted.elapsed_s
    forward, left, turn = predicted.twist_base
    position_m2, turn_rad2 = velocity_variance(elapsed_s)
    return OdometryIncrement(
        SE2.exp(elapsed_s * forward, elapsed_s * left, elapsed_s * turn), position_m2, turn_rad2
    )


def _covariance_between(begin: _Step, end: _Step) -> Matrix:
    """(3, 3) of the path by odometry between two steps, base axes."""
    position_m2 = end.variance_m2 - begin.variance_m2 + begin.end_m2 + end.end_m2
    turn_rad2 = end.variance_rad2 - begin.variance_rad2 + begin.end_rad2 + end.end_rad2
    return np.diag([position_m2, position_m2, turn_rad2])


def _conflict(begin: _Step, end: _Step) -> Conflict | None:
    reckoned, matched = begin.reckoned.between(end.reckoned), begin.matched.between(end.matched)
    off_m2 = (matched.x_m - reckoned.x_m) ** 2 + (matched.y_m - reckoned.y_m) ** 2
    travel_m = end.travel_m - begin.travel_m
    turn_rad2 = end.variance_rad2 - begin.variance_rad2 + MATCH_SIGMA_RAD**2
    turn_rad2 += begin.end_rad2 + end.end_rad2
    scale_m = USUAL.odometry_scale_sigma * travel_m
    position_m2 = end.variance_m2 - begin.variance_m2 + scale_m**2 + MATCH_SIGMA_M**2
    position_m2 += begin.end_m2 + end.end_m2
    position_m2 += turn_rad2 * travel_m**2 / 3.0  # random walk of the heading along the path
    turn_chi2 = wrap_angle(matched.theta_rad - reckoned.theta_rad) ** 2 / turn_rad2
    if off_m2 / position_m2 + turn_chi2 <= CHI2_999_OF_3:
        return None
    covariance = np.diag([position_m2, position_m2, turn_rad2])
    return Conflict(begin.matched @ reckoned, covariance, is_turned=turn_chi2 > CHI2_999_OF_1)


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
