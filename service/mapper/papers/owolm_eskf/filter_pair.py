"""Two filters of one drive: one corrected by walls only, one by every point of the map.

Along a bare corridor isolated points hold the pose back (across_walls.py); beside furniture only they fix it.
Both filters start equal where walls fix the position. While they agree, the pose is that of the points, which
is smoother; the covariance is always that of the walls.
"""

import copy
import math

import numpy as np

from service.estimator.motion import Matrix, Measurement
from service.geometry.chi2 import CHI2_999_OF_3
from service.geometry.se2 import SE2
from service.mapper.judgement import chi2_between, sigmas_of
from service.mapper.papers.owolm_eskf.error_state import ErrorStateFilter

BLIND_SIGMA = (100.0, 100.0, math.pi)  # m, m, rad: where a scan has no information
FIXED_M = 0.1  # largest sigma in the worst direction where walls fix the position; as `degraded_sigma_m`
# Share of the distance between both poses by which points moved theirs backwards: a half where odometry has
# the wrong sign, as that of fr079 in reverse; zero but for noise where points hold it back.
BACKWARDS_SHARE = 0.25
STEP_M = 0.05  # path length between two evaluations of it
MIN_COVARIANCE = 1e-6 * np.eye(3)


class FilterPair:
    """across: corrected by walls only. dots: by all points on the map; None: not in use."""

    def __init__(self, begun: ErrorStateFilter) -> None:
        self.across = begun
        self.dots: ErrorStateFilter | None = None
        self._is_confirmed = False
        self.is_fixed = True  # by the walls of the newest match
        self._drift = np.zeros((2, 2))  # m^2, of the visible ground against the first scan, odom axes
        self._counted = SE2(), SE2()  # both poses at the last evaluation
        self._backwards_m = 0.0  # motion of the points' pose against the path, since both were equal

    def confirm(self, is_confirmed: bool) -> None:
        """Whether odometry and IMU both measure the motion: then isolated points are not used."""
        self._is_confirmed = is_confirmed
        if is_confirmed:
            self.dots = None

    @property
    def all(self) -> list[ErrorStateFilter]:
        return [self.across] if self.dots is None else [self.across, self.dots]

    @property
    def best(self) -> ErrorStateFilter:
        return self.across if self.dots is None else self.dots

    def covariance(self) -> Matrix:
        """(3, 3) of the pose against the first scan, base axes.

        Behind a stretch whose length only the prediction determined, the map has its error.
        """
        covariance = self.across.pose_covariance()
        turn = _rotation(self.across.yaw_rad)
        covariance[:2, :2] += turn.T @ self._drift @ turn
        return covariance

    def observe(self, measured: Measurement) -> None:
        """Apply a match: its information is that of walls, its covariance that of all points."""
        if measured.prior_weight < 1.0:
            for each in self.all:
                each.scale_pose_information(measured.prior_weight)
        predicted, across = self.across.pose, _across(measured)
        self.is_fixed = sigmas_of(across)[0] <= FIXED_M
        before = self.across.pose_covariance()
        self.across.observe_pose(measured.pose_odom_base, across)
        if self.dots is None and sigmas_of(before)[0] > FIXED_M:
            turn = _rotation(predicted.theta_rad)
            self._drift += turn @ (before - self.across.pose_covariance())[:2, :2] @ turn.T
        if self.dots is not None:
            self.dots.observe_pose(measured.pose_odom_base, measured.covariance)
            self._compare(predicted, self.dots)
        elif not (self._is_confirmed or measured.is_joined) and self.is_fixed:
            self.dots = copy.deepcopy(self.across)
            self._begin_to_count()

    def _compare(self, predicted: SE2, dots: ErrorStateFilter) -> None:
        """Drop the filter of the points where the two contradict, unless odometry has the wrong sign."""
        path, by_dots = self._counted[0].between(predicted), self._counted[1].between(dots.pose)
        backwards_m = self._backwards_m + _backwards_m(path, by_dots)
        if math.hypot(path.x_m, path.y_m) >= STEP_M:
            self._backwards_m = backwards_m
            self._counted = self.across.pose, dots.pose
        covariance = self.across.pose_covariance() + MIN_COVARIANCE
        if chi2_between(self.across.pose, dots.pose, covariance) <= CHI2_999_OF_3:
            return
        apart = dots.position_m - self.across.position_m
        if backwards_m <= BACKWARDS_SHARE * float(np.hypot(*apart[:2])):
            self.dots = None
            return
        known = self.across.covariance  # not reduced
        self.across = copy.deepcopy(dots)
        self.across.covariance = known
        self._begin_to_count()

    def _begin_to_count(self) -> None:
        self._counted, self._backwards_m = (self.across.pose, self.best.pose), 0.0


def _backwards_m(path: SE2, by_dots: SE2) -> float:
    """Distance that the points' pose moved against a path; a small part is noise of a match."""
    length_m = math.hypot(path.x_m, path.y_m)
    if length_m == 0.0:
        return 0.0
    along_m = (by_dots.x_m * path.x_m + by_dots.y_m * path.y_m) / length_m
    return -along_m if along_m < -0.5 * length_m else 0.0


def _rotation(angle_rad: float) -> Matrix:
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, -s], [s, c]])


def _across(measured: Measurement) -> Matrix:
    """(3, 3) covariance of a scan alone, base axes; wide in unobservable directions."""
    least = np.diag(1.0 / np.square(BLIND_SIGMA)) if measured.is_joined else 0.0
    return np.asarray(np.linalg.inv(measured.information + least), np.float64)
