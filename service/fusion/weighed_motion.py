"""The motion model of the default profile: wheels if there are any, gyro for turns, else the last speed."""

import math

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

from drivers.frames import ImuSample, OdometrySample
from service.fusion.gyro import GyroTrack
from service.fusion.motion import Motion, Prediction
from service.fusion.wheel_odometry import OdometryTrack
from service.geometry.se2 import SE2

Twist = tuple[float, float, float]
STANDING: Twist = (0.0, 0.0, 0.0)


class MotionConfig(BaseModel):
    """How far each source of motion is trusted. d is the way since the last scan in m, a its turn in rad."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    position_sigma_m: float = Field(default=0.02, gt=0.0)
    position_sigma_per_m: float = Field(default=0.10, ge=0.0)
    position_sigma_per_rad_m: float = Field(default=0.02, ge=0.0)
    heading_sigma_rad: float = Field(default=0.02, gt=0.0)
    heading_sigma_per_rad: float = Field(default=0.15, ge=0.0)
    heading_sigma_per_m_rad: float = Field(default=0.02, ge=0.0)

    acceleration_mps2: float = Field(default=2.0, gt=0.0)  # of a speed that is only guessed
    turn_acceleration_radps2: float = Field(default=4.0, gt=0.0)
    first_speed_mps: float = Field(default=1.0, ge=0.0)  # without odometry, at the second scan
    first_turn_radps: float = Field(default=0.5, ge=0.0)

    gyro_sigma_rad: float = Field(default=0.005, gt=0.0)
    gyro_sigma_per_rad: float = Field(default=0.02, ge=0.0)
    gyro_bias_time_s: float = Field(default=20.0, gt=0.0)
    gyro_max_bias_radps: float = Field(default=0.05, ge=0.0)
    gyro_max_hold_s: float = Field(default=0.1, gt=0.0)

    odometry_max_speed_mps: float = Field(default=20.0, gt=0.0)
    odometry_max_turn_radps: float = Field(default=20.0, gt=0.0)
    odometry_max_guess_s: float = Field(default=1.0, ge=0.0)
    odometry_speed_window_s: float = Field(default=0.05, gt=0.0)

    twist_time_s: float = Field(default=0.03, gt=0.0)  # a speed is learnt from matches over about so long
    drift_m_per_sqrt_m: float = Field(default=0.03, ge=0.0)  # reported: how the wheels' error grows where
    drift_rad_per_sqrt_m: float = Field(default=0.01, ge=0.0)  # no match holds it
    drift_m_per_sqrt_s: float = Field(default=0.005, ge=0.0)


class WeighedMotion:
    """MotionModel. The odom frame is the base at the first scan."""

    def __init__(self, config: MotionConfig) -> None:
        self._config = config
        self._odometry = OdometryTrack(
            config.odometry_max_speed_mps,
            config.odometry_max_turn_radps,
            config.odometry_max_guess_s,
            config.odometry_speed_window_s,
        )
        self._gyro = GyroTrack(config.gyro_max_hold_s, config.gyro_bias_time_s, config.gyro_max_bias_radps)
        self._last: tuple[int, Motion] | None = None
        self._has_speed = False  # two scans were matched, so their difference is a speed

    def add(self, sample: ImuSample | OdometrySample) -> bool:
        if isinstance(sample, OdometrySample):
            return self._odometry.add(sample)
        return self._gyro.add(sample)

    def predict(self, stamp_ns: int) -> Prediction:
        if self._last is None:
            return self._first(stamp_ns)
        last_ns, last = self._last
        elapsed_s = (stamp_ns - last_ns) * 1e-9
        way = self._odometry.between(last_ns, stamp_ns)
        if way is not None:
            step, sigma_m, sigma_rad = way.motion, *self._wheel_sigmas(way.motion, way.guessed_s)
            twist = self._odometry.twist_at(stamp_ns) or last.twist_base
        else:
            step, sigma_m, sigma_rad = self._coast(last.twist_base, elapsed_s)
            twist = last.twist_base
        turn_rad = self._gyro.turn_between(last_ns, stamp_ns)
        if turn_rad is not None:
            forward, left, _ = step.log()
            step = SE2.exp(forward, left, turn_rad)
            sigma_rad = self._config.gyro_sigma_rad + self._config.gyro_sigma_per_rad * abs(turn_rad)
            rate = self._gyro.rate_at(stamp_ns)
            twist = (twist[0], twist[1], rate if rate is not None else twist[2])
        return Prediction(
            pose_odom_base=last.pose_odom_base @ step,
            twist_base=twist,
            covariance=self._grown(last.covariance, step, elapsed_s, way is not None, (sigma_m, sigma_rad)),
            step_covariance=np.diag([sigma_m**2, sigma_m**2, sigma_rad**2]),
            elapsed_s=elapsed_s,
            twist_gain=1.0 - math.exp(-elapsed_s / self._config.twist_time_s),
            is_measured=way is not None,
        )

    def correct(self, stamp_ns: int, matched: Motion) -> Motion:
        if self._last is not None:
            last_ns, last = self._last
            turned = last.pose_odom_base.inverse() @ matched.pose_odom_base
            self._gyro.learn_bias(last_ns, stamp_ns, turned.theta_rad)
            self._has_speed = True
        self._last = (stamp_ns, matched)
        return matched

    def _first(self, stamp_ns: int) -> Prediction:
        twist = self._odometry.twist_at(stamp_ns) or STANDING
        nothing = np.zeros((3, 3))
        return Prediction(SE2(), twist, nothing, nothing, elapsed_s=0.0, twist_gain=0.0, is_measured=False)

    def _wheel_sigmas(self, step: SE2, guessed_s: float) -> tuple[float, float]:
        config = self._config
        d, a = math.hypot(step.x_m, step.y_m), abs(step.theta_rad)
        guess = 0.5 * guessed_s**2
        return (
            config.position_sigma_m
            + config.position_sigma_per_m * d
            + config.position_sigma_per_rad_m * a
            + config.acceleration_mps2 * guess,
            config.heading_sigma_rad
            + config.heading_sigma_per_rad * a
            + config.heading_sigma_per_m_rad * d
            + config.turn_acceleration_radps2 * guess,
        )

    def _coast(self, twist: Twist, elapsed_s: float) -> tuple[SE2, float, float]:
        """Step and its sigmas when only the last speed is known, or not even that."""
        config = self._config
        step = SE2.exp(*(rate * elapsed_s for rate in twist))
        if not self._has_speed:
            return (
                step,
                config.position_sigma_m + config.first_speed_mps * elapsed_s,
                config.heading_sigma_rad + config.first_turn_radps * elapsed_s,
            )
        # 0.5 a t^2 within the interval, and as much again for the lag of the last speed
        return (
            step,
            config.position_sigma_m + config.acceleration_mps2 * elapsed_s**2,
            config.heading_sigma_rad + config.turn_acceleration_radps2 * elapsed_s**2,
        )

    def _grown(
        self,
        covariance: npt.NDArray[np.float64],
        step: SE2,
        elapsed_s: float,
        has_wheels: bool,
        sigmas: tuple[float, float],
    ) -> npt.NDArray[np.float64]:
        """Covariance of the pose after a step: carried along, and grown as a random walk."""
        config = self._config
        c, s = math.cos(step.theta_rad), math.sin(step.theta_rad)
        # a turn of the old base moves the new one; both expressed in the new base's axes
        carry = np.array(
            [
                [c, s, -c * step.y_m + s * step.x_m],
                [-s, c, s * step.y_m + c * step.x_m],
                [0.0, 0.0, 1.0],
            ]
        )
        d = math.hypot(step.x_m, step.y_m)
        if has_wheels:
            position = config.drift_m_per_sqrt_m**2 * d + config.drift_m_per_sqrt_s**2 * elapsed_s
            heading = config.drift_rad_per_sqrt_m**2 * (d + abs(step.theta_rad)) + 1e-8
        else:
            position, heading = sigmas[0] ** 2, sigmas[1] ** 2
        grown: npt.NDArray[np.float64] = carry @ covariance @ carry.T + np.diag([position, position, heading])
        return grown
