"""The motion model of an inertial unit that scans correct; where it is silent, wheels or the last speed."""

import math

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

from drivers.frames import ImuSample, OdometrySample
from service.fusion.motion import Matrix, Measurement, Motion, Prediction
from service.geometry.se2 import SE2, wrap_angle
from service.kernels.strapdown import ATTITUDE, FORCE_BIAS, RATE_BIAS, STATES, VELOCITY
from service.mapper.methods.owolm_eskf.error_state import ErrorStateFilter
from service.mapper.methods.owolm_eskf.inertial_track import InertialTrack
from service.mapper.methods.owolm_eskf.odometry_track import OdometryTrack

Twist = tuple[float, float, float]
STILL_STEP_NS = 100_000_000  # while standing, the filter is told so at this interval
STILL_SIGMA = (0.0005, 0.0005, 0.0001)  # m, m, rad: how still it stands
LEAST_STILL_SAMPLES = 20
BLIND_SIGMA = (100.0, 100.0, math.pi)  # m, m, rad: of what a scan says nothing about
ODOMETRY_MAX_GUESS_S, ODOMETRY_WINDOW_S = 1.0, 0.05


class InertialMotionConfig(BaseModel):
    """The IMU's errors and place, and what is assumed where it is silent."""

    model_config = ConfigDict(frozen=True, extra="forbid")

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
    max_hold_s: float = Field(default=0.1, gt=0.0)  # a sample stands in so long for missing ones
    still_rate_radps: float = Field(default=0.02, gt=0.0)  # scatter of a standing IMU
    still_force_mps2: float = Field(default=0.15, gt=0.0)

    first_speed_mps: float = Field(default=1.0, ge=0.0)  # sigma at the first scan, unless it is seen to stand
    floor_sigma_m: float = Field(default=0.05, gt=0.0)
    climb_sigma_mps: float = Field(default=0.05, gt=0.0)

    wheel_speed_sigma_mps: float = Field(default=0.1, gt=0.0)  # beside an IMU
    position_sigma_m: float = Field(default=0.02, gt=0.0)  # wheels alone: + per_m * d
    position_sigma_per_m: float = Field(default=0.10, ge=0.0)
    heading_sigma_rad: float = Field(default=0.02, gt=0.0)
    heading_sigma_per_rad: float = Field(default=0.15, ge=0.0)
    heading_sigma_per_m_rad: float = Field(default=0.02, ge=0.0)
    acceleration_mps2: float = Field(default=2.0, gt=0.0)  # of a speed that is only guessed
    turn_acceleration_radps2: float = Field(default=4.0, gt=0.0)


class InertialMotion:
    """MotionModel. The odom frame is the base at the first scan, levelled."""

    fault = ""  # the filter weighs by its own covariances

    def __init__(self, config: InertialMotionConfig) -> None:
        self._config = config
        self._track = InertialTrack(config.imu_yaw_rad, config.max_hold_s)
        self._odometry = OdometryTrack(ODOMETRY_MAX_GUESS_S, ODOMETRY_WINDOW_S)
        self._filter = self._new_filter()
        self._at_ns: int | None = None  # where the filter stands
        self._matched: tuple[int, SE2] | None = None
        self._turn_radps = 0.0  # between the last two matches
        self._rate = np.zeros(3)  # of the body at the last prediction, bias included

    def add(self, sample: ImuSample | OdometrySample) -> bool:
        if isinstance(sample, OdometrySample):
            return self._odometry.add(sample)
        return self._track.add(sample)

    def predict(self, stamp_ns: int) -> Prediction:
        if self._at_ns is None:
            return self._first(stamp_ns)
        elapsed_s = (stamp_ns - self._at_ns) * 1e-9
        before = self._filter.pose
        wheels = self._odometry.between(self._at_ns, stamp_ns)
        wheel_twist = self._odometry.twist_at(stamp_ns) if wheels is not None else None
        is_inertial = self._track.covers(self._at_ns, stamp_ns)
        if is_inertial:
            for step in self._track.steps(self._at_ns, stamp_ns):
                self._filter.advance(*step)
            self._rate = self._track.rate_at(stamp_ns)
            self._filter.settle()
            if wheel_twist is not None:
                self._filter.observe_speed(wheel_twist[:2], self._rate, self._config.wheel_speed_sigma_mps)
        else:
            self._move(elapsed_s, wheels.motion if wheels is not None else None, wheel_twist)
            self._filter.settle()
        self._filter.observe_floor(self._config.floor_sigma_m, self._config.climb_sigma_mps)
        self._forget(stamp_ns)
        pose, covariance = self._filter.pose, self._filter.pose_covariance()
        return Prediction(
            pose_odom_base=pose,
            twist_base=self._twist(),
            covariance=covariance,
            local_covariance=covariance,
            twist_gain=np.zeros((3, 3)),  # the filter learns speed itself
            elapsed_s=elapsed_s,
            travel_m=math.dist((before.x_m, before.y_m), (pose.x_m, pose.y_m)),
            is_measured=is_inertial or wheels is not None,
            is_confirmed=is_inertial and wheel_twist is not None,
        )

    def correct(self, measured: Measurement | None) -> Motion:
        if measured is not None and self._at_ns is not None:
            if measured.prior_weight < 1.0:
                self._filter.doubt_pose(measured.prior_weight)
            self._filter.observe_pose(measured.pose_odom_base, _of_the_scan_alone(measured))
            pose = self._filter.pose
            if self._matched is not None and self._matched[0] < self._at_ns:
                last_ns, last = self._matched
                elapsed_s = (self._at_ns - last_ns) * 1e-9
                self._turn_radps = wrap_angle(pose.theta_rad - last.theta_rad) / elapsed_s
            self._matched = (self._at_ns, pose)
        return Motion(self._filter.pose, self._twist(), self._filter.pose_covariance())

    def settle(self, share: float) -> None:
        """The filter has one pose, and its error against the map is its error."""

    def _forget(self, stamp_ns: int) -> None:
        """Samples from before a scan, and stand where it is."""
        self._track.use_up(stamp_ns)
        self._odometry.use_up(stamp_ns)
        self._at_ns = stamp_ns

    def _first(self, stamp_ns: int) -> Prediction:
        self._align(stamp_ns)
        if (twist := self._odometry.twist_at(stamp_ns)) is not None:
            self._filter.velocity_mps = np.array([twist[0], twist[1], 0.0])
        self._forget(stamp_ns)
        self._matched = (stamp_ns, SE2())
        nothing = np.zeros((3, 3))
        return Prediction(
            SE2(), self._twist(), nothing, nothing, nothing, elapsed_s=0.0, travel_m=0.0, is_measured=False
        )

    def _align(self, stamp_ns: int) -> None:
        """Tilt and biases from before the first scan, if the vehicle stood; else level, unbiased."""
        stamps, felt = self._track.before(stamp_ns)
        if len(stamps) < LEAST_STILL_SAMPLES or not self._track.covers(stamps[0], stamp_ns):
            return
        scatter = felt.std(axis=0)
        if (
            scatter[:3].max() > self._config.still_force_mps2
            or scatter[3:].max() > self._config.still_rate_radps
        ):
            return
        ahead, left, up = felt[:, :3].mean(axis=0)
        roll, pitch = math.atan2(left, up), math.atan2(-ahead, math.hypot(left, up))
        filter_ = self._filter
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
        self._rate = felt[-1, 3:]

    def _move(self, elapsed_s: float, way: SE2 | None, wheel_twist: Twist | None) -> None:
        config = self._config
        guess = elapsed_s**2  # 0.5 a t^2 within the interval, and as much for the lag of the last speed
        self._rate = self._filter.rate_bias + np.array([0.0, 0.0, self._turn_radps])
        if way is not None and wheel_twist is not None:
            d, a = math.hypot(way.x_m, way.y_m), abs(way.theta_rad)
            self._rate[2] = self._filter.rate_bias[2] + wheel_twist[2]
            sigmas = (
                config.position_sigma_m + config.position_sigma_per_m * d,
                config.heading_sigma_rad
                + config.heading_sigma_per_rad * a
                + config.heading_sigma_per_m_rad * d,
                config.wheel_speed_sigma_mps,
            )
            self._filter.move(way, elapsed_s, wheel_twist, np.array(sigmas), is_measured=True)
            return
        twist = self._twist()
        step = SE2.exp(*(rate * elapsed_s for rate in twist))
        sigmas = (
            config.position_sigma_m + config.acceleration_mps2 * guess,
            config.heading_sigma_rad + config.turn_acceleration_radps2 * guess,
            config.acceleration_mps2 * elapsed_s,
        )
        self._filter.move(step, elapsed_s, twist, np.array(sigmas), is_measured=False)

    def _twist(self) -> Twist:
        forward, left, _ = self._filter.base_velocity(self._rate)
        return float(forward), float(left), float(self._rate[2] - self._filter.rate_bias[2])

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
        sigma = np.zeros(STATES)
        sigma[VELOCITY : VELOCITY + 2] = config.first_speed_mps
        sigma[ATTITUDE : ATTITUDE + 2] = config.tilt_sigma_rad
        sigma[FORCE_BIAS:RATE_BIAS] = config.force_bias_mps2
        sigma[RATE_BIAS:] = config.rate_bias_radps
        new.covariance = np.diag(sigma**2)
        return new


def _of_the_scan_alone(measured: Measurement) -> Matrix:
    """(3, 3) covariance of what a scan says without any prediction, base axes; wide where it says nothing."""
    if not measured.is_joined:
        return measured.covariance
    return np.asarray(np.linalg.inv(measured.information + np.diag(1.0 / np.square(BLIND_SIGMA))), np.float64)


def _tilted(roll_rad: float, pitch_rad: float) -> npt.NDArray[np.float64]:
    cr, sr = math.cos(roll_rad), math.sin(roll_rad)
    cp, sp = math.cos(pitch_rad), math.sin(pitch_rad)
    return np.array([[cp, sp * sr, sp * cr], [0.0, cr, -sr], [-sp, cp * sr, cp * cr]])
