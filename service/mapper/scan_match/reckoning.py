"""The path by odometry and gyro, compared with the matched one; conflicts of [35]."""

import math
from collections import deque
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from service.estimator.motion import OdometryIncrement, Prediction
from service.geometry.chi2 import CHI2_999_OF_1, CHI2_999_OF_3
from service.geometry.se2 import SE2, wrap_angle
from service.kernels.increments import MAX_SILENT_S
from service.mapper.scan_match.attempt import Matrix
from service.mapper.scan_match.inertia import USUAL, largest_inertia_cost, velocity_variance

# Over which both paths are compared, whichever is shorter; a window without moving returns is static again.
WINDOW_NS, PATH_WINDOW_M = 1_000_000_000, 0.5
MATCH_SIGMA_M, MATCH_SIGMA_RAD = 0.005, 0.003  # of the ends of the matched path
MATCH_COVARIANCE = np.diag([MATCH_SIGMA_M**2, MATCH_SIGMA_M**2, MATCH_SIGMA_RAD**2])  # (3, 3), base axes


@dataclass(frozen=True, slots=True)
class _Step:
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
            steps[-1] = replace(steps[-1], matched=matched)
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
