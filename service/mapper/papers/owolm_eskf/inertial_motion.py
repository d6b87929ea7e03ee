"""Motion model of an IMU corrected by scans; where it is silent, odometry or constant velocity."""

import math

import numpy as np
import numpy.typing as npt
from pydantic import Field

from drivers.frames import ImuSample, OdometrySample
from drivers.section import Section
from service.estimator.motion import Measurement, Motion, Prediction
from service.geometry.se2 import SE2, wrap_angle
from service.kernels.strapdown import ATTITUDE, FORCE_BIAS, RATE_BIAS, STRAPDOWN_STATES, VELOCITY
from service.mapper.papers.owolm_eskf.error_state import ErrorStateFilter
from service.mapper.papers.owolm_eskf.filter_pair import FilterPair
from service.mapper.papers.owolm_eskf.inertial_track import InertialTrack
from service.mapper.papers.owolm_eskf.odometry_track import OdometryTrack
from service.outputs import NO_REASON, Reason

Twist = tuple[float, float, float]
STILL_STEP_NS = 100_000_000  # interval of zero-motion updates at standstill
STILL_SIGMA = (0.0005, 0.0005, 0.0001)  # m, m, rad: of a zero-motion update
MIN_STILL_SAMPLES = 20
MAX_UNKNOWN_S = 0.3  # at 1 m/s the distance between inserted scans
ODOMETRY_MAX_GUESS_S, ODOMETRY_WINDOW_S = 1.0, 0.05


class InertialMotionConfig(Section):
    """Errors and mounting of the IMU, and assumptions while it is silent."""

    imu_x_m: float = 0.0  # the IMU in the base frame
    imu_y_m: float = 0.0
    imu_yaw_rad: float = 0.0
    gravity_mps2: float = Field(default=9.81, gt=9.0, lt=10.0)

    force_density_mps2: float = Field(default=0.003, gt=0.0)  # per square root of Hz
    rate_density_radps: float = Field(default=0.0009, gt=0.0)
    force_bias_mps2: float = Field(default=0.02, gt=0.0)  # 2000 mGal
    rate_bias_radps: float = Field(default=0.001, gt=0.0)  # 200 deg/h
    bias_time_s: float = Field(default=600.0, gt=0.0)  # a bias walks by its own size in this time
    tilt_sigma_rad: float = Field(default=0.03, gt=0.0)  # at the start
    max_hold_s: float = Field(default=0.1, gt=0.0)  # for which a sample replaces missing ones
    still_rate_radps: float = Field(default=0.02, gt=0.0)  # scatter of a standing IMU
    still_force_mps2: float = Field(default=0.15, gt=0.0)

    first_speed_mps: float = Field(default=1.0, ge=0.0)  # sigma at the first scan, unless at standstill
    floor_sigma_m: float = Field(default=0.05, gt=0.0)
    climb_sigma_mps: float = Field(default=0.05, gt=0.0)

    wheel_speed_sigma_mps: float = Field(default=0.1, gt=0.0)  # beside an IMU
    position_sigma_m: float = Field(default=0.02, gt=0.0)  # odometry alone: + per_m * d
    position_sigma_per_m: float = Field(default=0.10, ge=0.0)
    heading_sigma_rad: float = Field(default=0.02, gt=0.0)
    heading_sigma_per_rad: float = Field(default=0.15, ge=0.0)
    heading_sigma_per_m_rad: float = Field(default=0.02, ge=0.0)
    acceleration_mps2: float = Field(default=2.0, gt=0.0)  # at constant velocity
    turn_acceleration_radps2: float = Field(default=4.0, gt=0.0)


class InertialMotion:
    """MotionModel. The odom frame is the base at the first scan, levelled."""

    def __init__(self, config: InertialMotionConfig) -> None:
        self._config = config
        self._track = InertialTrack(config.imu_yaw_rad, config.max_hold_s)
        self._odometry = OdometryTrack(ODOMETRY_MAX_GUESS_S, ODOMETRY_WINDOW_S)
        self.filters = FilterPair(self._new_filter())
        self._is_inertial = False  # the IMU made the newest prediction
        self._at_ns: int | None = None  # time of the filter's state
        self._matched: tuple[int, SE2] | None = None
        self._unknown_s = 0.0  # in which neither walls nor a sensor measured the motion
        self._turn_radps = 0.0  # between the last two matches
        self._turn = 0.0  # rad/s at the newest prediction, while the IMU is silent
        self._rate = np.zeros(3)  # of the body at the last prediction, bias included

    @property
    def fault(self) -> Reason:
        """A stretch of unmeasured length, which the covariance does not cover; or NO_REASON."""
        if self._unknown_s <= MAX_UNKNOWN_S:
            return NO_REASON
        return Reason(
            "unmeasured_way",
            f"neither IMU nor odometry measured the motion over {self._unknown_s:.1f} s in which walls did "
            "not fix the position: the map may have slipped there. Are both connected?",
        )

    def add(self, sample: ImuSample | OdometrySample) -> bool:
        if isinstance(sample, OdometrySample):
            return self._odometry.add(sample)
        return self._track.add(sample)

    def begin_at(self, stamp_ns: int) -> None:
        self._first(stamp_ns)

    def predict(self, stamp_ns: int) -> Prediction:
        if self._at_ns is None:
            return self._first(stamp_ns)
        elapsed_s = (stamp_ns - self._at_ns) * 1e-9
        before = self.filters.best.pose
        wheels = self._odometry.between(self._at_ns, stamp_ns)
        wheel_twist = self._odometry.twist_at(stamp_ns) if wheels is not None else None
        self._is_inertial = self._track.covers(self._at_ns, stamp_ns)
        is_confirmed = self._is_inertial and wheel_twist is not None
        self.filters.confirm(is_confirmed)
        steps = list(self._track.steps(self._at_ns, stamp_ns)) if self._is_inertial else []
        if self._is_inertial:
            self._rate = self._track.rate_at(stamp_ns)
        for each in self.filters.all:
            for step in steps:
                each.advance(*step)
            if not self._is_inertial:
                self._move(each, elapsed_s, wheels, wheel_twist)
            each.settle()
            if is_confirmed and wheel_twist is not None:
                each.observe_speed(wheel_twist[:2], self._rate, self._config.wheel_speed_sigma_mps)
            each.observe_floor(self._config.floor_sigma_m, self._config.climb_sigma_mps)
        self._forget(stamp_ns)
        if not self._is_inertial and wheels is None and not self.filters.is_fixed:
            self._unknown_s += elapsed_s
        pose = self.filters.best.pose
        return Prediction(
            pose_odom_base=pose,
            twist_base=self._twist(),
            covariance=self.filters.covariance(),
            local_covariance=self.filters.best.pose_covariance(),
            twist_covariance=np.zeros((3, 3)),  # the filter estimates the speed itself
            elapsed_s=elapsed_s,
            travel_m=math.dist((before.x_m, before.y_m), (pose.x_m, pose.y_m)),
            is_measured=self._is_inertial or wheels is not None,
            is_confirmed=is_confirmed,
        )

    def correct(self, measured: Measurement | None) -> Motion:
        if measured is not None and self._at_ns is not None:
            self.filters.observe(measured)
            pose = self.filters.best.pose
            if self._matched is not None and self._matched[0] < self._at_ns:
                last_ns, last = self._matched
                elapsed_s = (self._at_ns - last_ns) * 1e-9
                self._turn_radps = wrap_angle(pose.theta_rad - last.theta_rad) / elapsed_s
            self._matched = (self._at_ns, pose)
        return Motion(self.filters.best.pose, self._twist(), self.filters.covariance())

    def moved(self, seconds: float) -> Motion:
        twist = self._twist()
        step = SE2.exp(*(seconds * speed for speed in twist))
        return Motion(self.filters.best.pose @ step, twist, self.filters.covariance())

    def settle(self, share: float) -> None:
        """Nothing to do: the filter has a single pose error."""

    def _forget(self, stamp_ns: int) -> None:
        """Drop the samples before a scan, and set the time of the state."""
        self._track.use_up(stamp_ns)
        self._odometry.use_up(stamp_ns)
        self._at_ns = stamp_ns

    def _first(self, stamp_ns: int) -> Prediction:
        self._align(stamp_ns)
        if (twist := self._odometry.twist_at(stamp_ns)) is not None:
            self.filters.across.velocity_mps = np.array([twist[0], twist[1], 0.0])
        self._forget(stamp_ns)
        self._matched = (stamp_ns, SE2())
        nothing = np.zeros((3, 3))
        return Prediction(
            SE2(), self._twist(), nothing, nothing, nothing, elapsed_s=0.0, travel_m=0.0, is_measured=False
        )

    def _align(self, stamp_ns: int) -> None:
        """Estimate tilt and biases before the first scan, if the vehicle stood; else level, unbiased."""
        stamps, felt = self._track.before(stamp_ns)
        if len(stamps) < MIN_STILL_SAMPLES or not self._track.covers(stamps[0], stamp_ns):
            return
        scatter = felt.std(axis=0)
        if (
            scatter[:3].max() > self._config.still_force_mps2
            or scatter[3:].max() > self._config.still_rate_radps
        ):
            return
        ahead, left, up = felt[:, :3].mean(axis=0)
        roll, pitch = math.atan2(left, up), math.atan2(-ahead, math.hypot(left, up))
        filter_ = self.filters.across
        filter_.rotation = _tilted(roll, pitch)
        filter_.position_m = filter_.rotation @ np.array([self._config.imu_x_m, self._config.imu_y_m, 0.0])
        filter_.covariance[VELOCITY:ATTITUDE, VELOCITY:ATTITUDE] = 1e-4 * np.eye(3)
        stillness = np.diag(np.square(STILL_SIGMA))
        at_ns = stamps[0]
        while at_ns < stamp_ns:
            until_ns = min(at_ns + STILL_STEP_NS, stamp_ns)
            for step in self._track.steps(at_ns, until_ns):
                filter_.advance(*step)
            filter_.settle()
            filter_.observe_pose(SE2(), stillness)
            filter_.observe_floor(self._config.floor_sigma_m, self._config.climb_sigma_mps)
            at_ns = until_ns
        filter_.place_at_origin()
        self._rate, self._is_inertial = felt[-1, 3:], True

    def _move(
        self,
        filter_: ErrorStateFilter,
        elapsed_s: float,
        step_by_odometry: SE2 | None,
        wheel_twist: Twist | None,
    ) -> None:
        config = self._config
        guess = elapsed_s**2  # 0.5 a t^2 within the interval, and as much for the delay of the last speed
        self._turn = self._turn_radps if wheel_twist is None else wheel_twist[2]
        if step_by_odometry is not None and wheel_twist is not None:
            d, a = math.hypot(step_by_odometry.x_m, step_by_odometry.y_m), abs(step_by_odometry.theta_rad)
            sigmas = (
                config.position_sigma_m + config.position_sigma_per_m * d,
                config.heading_sigma_rad
                + config.heading_sigma_per_rad * a
                + config.heading_sigma_per_m_rad * d,
                config.wheel_speed_sigma_mps,
            )
            filter_.move(step_by_odometry, elapsed_s, wheel_twist, np.array(sigmas), is_measured=True)
            return
        twist = self._twist_of(filter_)
        step = SE2.exp(*(rate * elapsed_s for rate in twist))
        sigmas = (
            config.position_sigma_m + config.acceleration_mps2 * guess,
            config.heading_sigma_rad + config.turn_acceleration_radps2 * guess,
            config.acceleration_mps2 * elapsed_s,
        )
        filter_.move(step, elapsed_s, twist, np.array(sigmas), is_measured=False)

    def _twist(self) -> Twist:
        return self._twist_of(self.filters.best)

    def _twist_of(self, filter_: ErrorStateFilter) -> Twist:
        rate = self._rate if self._is_inertial else filter_.rate_bias + np.array([0.0, 0.0, self._turn])
        forward, left, _ = filter_.base_velocity(rate)
        return float(forward), float(left), float(rate[2] - filter_.rate_bias[2])

    def _new_filter(self) -> ErrorStateFilter:
        config = self._config
        walk = 1.0 / math.sqrt(config.bias_time_s)
        new = ErrorStateFilter(
            np.array([config.imu_x_m, config.imu_y_m, 0.0]),
            config.gravity_mps2,
            np.array(
                [
                    config.force_density_mps2,
                    config.rate_density_radps,
                    config.force_bias_mps2 * walk,
                    config.rate_bias_radps * walk,
                ]
            ),
        )
        sigma = np.zeros(STRAPDOWN_STATES)
        sigma[VELOCITY : VELOCITY + 2] = config.first_speed_mps
        sigma[ATTITUDE : ATTITUDE + 2] = config.tilt_sigma_rad
        sigma[FORCE_BIAS:RATE_BIAS] = config.force_bias_mps2
        sigma[RATE_BIAS:] = config.rate_bias_radps
        new.covariance = np.diag(sigma**2)
        return new


def _tilted(roll_rad: float, pitch_rad: float) -> npt.NDArray[np.float64]:
    cr, sr = math.cos(roll_rad), math.sin(roll_rad)
    cp, sp = math.cos(pitch_rad), math.sin(pitch_rad)
    return np.array([[cp, sp * sr, sp * cr], [0.0, cr, -sr], [-sp, cp * sr, cp * cr]])
