"""Check whether the vehicle moves along its heading by odometry; else a laser's mounting is wrong.

The map of one laser is consistent for any mounting: a wrong one shows only in the comparison of scan matching
with odometry. With E the pose of the base as configured in the base of odometry, a step B of scan matching is
E^-1 O E for a step O of odometry. With o, b the translations, R the rotation of both, t the translation of E
and s the scale of odometry, this is linear in the unknowns: s o = E b - (R - I) t (Censi, Franchi,
Marchionni, Oriolo: Simultaneous calibration of odometry and sensor parameters for mobile robots, IEEE
Transactions on Robotics 29, 2013). `corridor calibrate` estimates the same offline, more accurately.
"""

import math
from collections import deque
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from drivers.frames import OdometrySample
from service.estimator.motion import PAUSE_NS
from service.geometry.chi2 import CHI2_99_OF_3, CHI2_999_OF_3
from service.geometry.se2 import SE2, wrap_angle
from service.kernels.step_offset import MIN_TURN_RAD, fit_step_offset
from service.mapper.checks.stamp_check import BATCH
from service.outputs import NO_REASON, Reason

Floats = npt.NDArray[np.float64]
MOUNTING_STEP_M, MOUNTING_STEP_RAD = 0.4, 0.15  # either ends a step
LONGEST_STEP_NS = 3_000_000_000
SAMPLES_KEPT = 512  # of odometry
STEPS = 200  # the newest are used: 80 m and more
# Two measurements each, of four unknowns. The first ones are shorter, 0.05, 0.1 and 0.2 m: a laser turned by
# 180 deg shows before the pose is far off.
MIN_STEPS = 3
NEWEST_M = 3.0  # of the path, which shows by itself that a laser was knocked, or set right
NEW_STEPS = 4  # between two evaluations of that
MIN_OPPOSED_RAD = 3.0  # total rotation before opposed rotations are significant
MAX_SCALE = 2.0  # or its inverse: beyond, odometry is unusable for this check
AXLE_TOLERANCE = np.diag([0.05, 0.05, math.radians(0.5)]) ** 2  # m, m, rad: of axle and mounting by hand
NO_EXCESS = np.ones(2)  # factors on the assumed variance: as assumed
KNOWN_SIGMA_M = 1.0  # of the centre of rotation: a path without turns does not show it


class Offset(NamedTuple):
    """The base as configured in the base of odometry."""

    offset: Floats  # (3,) x, y m and yaw rad
    covariance: Floats  # (3, 3)
    excess: Floats  # (2,) factors on the assumed variance of a step, along and across it


class OdometryMounting:
    """Compares steps of scan matching with those of odometry; `fault` is NO_REASON while they agree."""

    def __init__(self) -> None:
        self.fault = NO_REASON
        self._samples: deque[tuple[int, SE2]] = deque(maxlen=SAMPLES_KEPT)
        self._waiting: tuple[int, SE2] | None = None  # a pose newer than odometry
        self._last: tuple[int, SE2, SE2] | None = None  # end of the last step: stamp, by scans, by odometry
        self._steps = np.empty((0, 6))  # the newest; as of fault_of
        self._excess = NO_EXCESS  # least factors on the assumed variance of a step
        self._count = 0  # of steps

    def add_odometry(self, sample: OdometrySample) -> None:
        """Add the next sample, in the order of stamps."""
        if self._samples and sample.stamp_ns - self._samples[-1][0] > PAUSE_NS:
            self._last = None  # the motion in the pause is unknown
        self._samples.append((sample.stamp_ns, SE2(sample.x_m, sample.y_m, sample.theta_rad)))
        if self._waiting is not None and sample.stamp_ns >= self._waiting[0]:
            stamp_ns, pose = self._waiting
            self._waiting = None
            self.add_pose(stamp_ns, pose)

    def add_pose(self, stamp_ns: int, pose_odom_base: SE2) -> None:
        """Add the pose of a matched scan, in the order of stamps."""
        if not self._samples:
            return
        if stamp_ns > self._samples[-1][0]:
            self._waiting = stamp_ns, pose_odom_base
            return
        last = self._last
        if last is not None and stamp_ns - last[0] > LONGEST_STEP_NS:
            last = None
        step_m = MOUNTING_STEP_M / 2 ** max(0, MIN_STEPS - self._count)
        if last is not None and not (
            pose_odom_base.is_step_from(last[1], step_m, MOUNTING_STEP_RAD)
            or self._samples[-1][1].is_step_from(last[2], step_m, math.inf)
        ):
            return
        odometry = self._odometry_at(stamp_ns)
        self._last = None if odometry is None else (stamp_ns, pose_odom_base, odometry)
        if last is None or odometry is None:
            return
        matched, driven = last[1].between(pose_odom_base), last[2].between(odometry)
        self._steps = np.vstack((self._steps[1 - STEPS :], (*matched, *driven)))
        self._count += 1
        has_changed = self._count % NEW_STEPS == 0 and self._forget_another_mounting()
        if has_changed or MIN_STEPS <= self._count < BATCH or self._count % BATCH == 0:
            self.fault = fault_of(self._steps, self._excess)

    def _forget_another_mounting(self) -> bool:
        """Drop the steps before the newest ones where these show another mounting; whether they do."""
        steps = self._steps
        path_m = np.hypot(steps[:, 3], steps[:, 4])[::-1].cumsum()
        newest = int(np.searchsorted(path_m, NEWEST_M)) + 1
        if len(steps) < 2 * newest or (was := offset_of(steps[:-newest], self._excess)) is None:
            return False
        now = offset_of(steps[-newest:])
        if now is None or not is_another(was, now):
            return False
        self._steps = steps[-newest:]
        self._excess = was.excess  # few steps do not show the noise
        return True

    def interrupt(self) -> None:
        """Discard the current step after the pose was lost."""
        self._last = self._waiting = None

    def _odometry_at(self, stamp_ns: int) -> SE2 | None:
        """Interpolated odometry; None where it was silent."""
        newest_first = reversed(self._samples)
        for (after_ns, after), (before_ns, before) in pairwise(newest_first):
            if before_ns <= stamp_ns <= after_ns:
                if after_ns - before_ns > PAUSE_NS:
                    return None
                share = (stamp_ns - before_ns) / (after_ns - before_ns)
                turn_rad = wrap_angle(after.theta_rad - before.theta_rad)
                return SE2(
                    before.x_m + share * (after.x_m - before.x_m),
                    before.y_m + share * (after.y_m - before.y_m),
                    before.theta_rad + share * turn_rad,
                )
        return None


def fault_of(steps: Floats, min_excess: Floats = NO_EXCESS) -> Reason:
    """The fault that steps show; NO_REASON where scans and odometry agree.

    steps   (K, 6) x, y m and theta rad by scan matching, then by odometry, in the base at their start
    min_excess   as of offset_of
    """
    if turns_are_opposed(steps):
        return Reason(
            "odometry_turns_opposed",
            "odometry turns the other way than the scans; is a laser mounted upside down, contrary to its "
            "mounting in the config, or are the wheels of odometry swapped?",
        )
    found = offset_of(steps, min_excess)
    if found is None:
        return NO_REASON
    offset, covariance, _excess = found
    # MIN_STEPS do not show the noise: it may be twice the assumed one.
    most = CHI2_999_OF_3 * max(1.0, 4.0 * MIN_STEPS / len(steps))
    if float(offset @ np.linalg.solve(covariance + AXLE_TOLERANCE, offset)) <= most:
        return NO_REASON
    axle = SE2(*offset.tolist()).inverse()
    yaw_deg = math.degrees(axle.theta_rad)
    side = "left" if yaw_deg > 0 else "right"
    sigma_m, sigma_deg = math.sqrt(covariance[:2, :2].trace() / 2), math.degrees(math.sqrt(covariance[2, 2]))
    point = f"{axle.x_m:+z.2f} m ahead and {axle.y_m:+z.2f} m left of its base (sigma {sigma_m:.2f})"
    if sigma_m > KNOWN_SIGMA_M:
        point = "that is not known"
    return Reason(
        "odometry_mounting",
        f"by odometry the vehicle drives {abs(yaw_deg):.1f} deg to the {side} of "
        f"its heading (sigma {sigma_deg:.1f}) and turns around a point {point}; are the lasers "
        "mounted as configured, are the signs of odometry right? corridor calibrate measures mountings",
    )


def is_another(was: Offset, now: Offset) -> bool:
    """Whether two offsets differ by more than their errors."""
    apart = now.offset - was.offset
    apart[2] = wrap_angle(float(apart[2]))
    covariance = was.covariance + now.covariance + AXLE_TOLERANCE
    return float(apart @ np.linalg.solve(covariance, apart)) > CHI2_99_OF_3


def turns_are_opposed(steps: Floats) -> bool:
    """Whether scans and odometry rotate equally far in opposite directions.

    A laser mounted upside down maps a mirror image of the place, which is consistent in itself.
    """
    matched, driven = steps[:, 2], steps[:, 5]
    does_turn = np.abs(matched) > MIN_TURN_RAD
    if np.abs(matched[does_turn]).sum() < MIN_OPPOSED_RAD:
        return False
    ratio = float(np.median(driven[does_turn] / matched[does_turn]))
    return 1.0 / MAX_SCALE <= -ratio <= MAX_SCALE


def offset_of(steps: Floats, min_excess: Floats = NO_EXCESS) -> Offset | None:
    """The offset that steps (K, 6) as of fault_of show; None where odometry is dead or its scale far from 1.

    min_excess   (2,) least factors on the assumed variance of a step, as of Offset
    """
    unknown, covariance, excess = np.empty(4), np.empty((4, 4)), min_excess.copy()
    fit_step_offset(np.ascontiguousarray(steps), excess, unknown, covariance)
    inverse_scale = math.hypot(unknown[0], unknown[1])
    if not 1.0 / MAX_SCALE <= inverse_scale <= MAX_SCALE:
        return None
    yaw_rad = math.atan2(unknown[1], unknown[0])
    offset = np.array([*(unknown[2:] / inverse_scale), yaw_rad])
    to_offset = np.zeros((3, 4))
    to_offset[0, 2] = to_offset[1, 3] = 1.0 / inverse_scale
    to_offset[2, :2] = -math.sin(yaw_rad) / inverse_scale, math.cos(yaw_rad) / inverse_scale
    return Offset(offset, to_offset @ covariance @ to_offset.T, excess)
