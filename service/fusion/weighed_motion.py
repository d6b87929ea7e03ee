"""The motion model of the default profile: wheels if there are any, gyro for turns, else the last speed."""

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

from drivers.frames import ImuSample, OdometrySample
from service.fusion.drift import MapDrift, WheelWalk, carried, on_the_map
from service.fusion.gyro import GyroTrack
from service.fusion.motion import Matched, Motion, Prediction
from service.fusion.source_trust import Noise, SourceTrust
from service.fusion.wheel_lag import WheelLag
from service.fusion.wheel_odometry import OdometryTrack
from service.fusion.wheel_trust import WheelTrust
from service.geometry.se2 import SE2
from service.kernels.pose_information import invert_3x3

Twist = tuple[float, float, float]
STANDING: Twist = (0.0, 0.0, 0.0)
STILL_M, STILL_RAD = 1e-4, 1e-4  # wheels that turn less between two scans stand still
PUSHED_SIGMAS = 4.0  # a match so far from where it stood, by its standing sigmas, is a push
PUSHED_NS = 1_000_000_000  # after which wheels that stand are believed again
SLIP_SIGMAS = 4.0  # so far from the prediction wheels slipped or froze, which says nothing of their size
UNKNOWN = np.zeros((3, 3))  # information of a scan that was not matched


class MotionConfig(BaseModel):
    """How far each source of motion is trusted. d is the way since the last scan in m, a its turn in rad."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    position_sigma_m: float = Field(default=0.02, gt=0.0)
    position_sigma_per_m: float = Field(default=0.10, ge=0.0)
    position_sigma_per_rad_m: float = Field(default=0.02, ge=0.0)
    heading_sigma_rad: float = Field(default=0.02, gt=0.0)
    heading_sigma_per_rad: float = Field(default=0.15, ge=0.0)
    heading_sigma_per_m_rad: float = Field(default=0.02, ge=0.0)
    standing_sigma_m: float = Field(default=0.001, gt=0.0)  # while the wheels stand still
    standing_sigma_rad: float = Field(default=0.0003, gt=0.0)

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
    wheel_scale_sigma: float = Field(default=0.01, ge=0.0)  # of a wheel's way, before anything is learnt
    wheel_window_m: float = Field(default=0.5, gt=0.0)  # a pair of ways is compared after so much
    wheel_window_rad: float = Field(default=1.0, gt=0.0)
    wheel_learn_sigma_m: float = Field(default=0.02, gt=0.0)  # ... if the walls know the way so well
    wheel_learn_sigma_rad: float = Field(default=0.01, gt=0.0)

    wheel_lag_sigma_s: float = Field(default=0.1, ge=0.0)  # of the wheels' stamps, before anything is learnt
    wheel_jitter_s: float = Field(default=0.05, ge=0.0)  # ... and of each by itself
    wheel_most_lag_s: float = Field(default=0.5, ge=0.0)

    drift_m_per_sqrt_m: float = Field(default=0.02, ge=0.0)  # reported: how the wheels' error grows where
    drift_rad_per_sqrt_m: float = Field(default=0.01, ge=0.0)  # no match holds it
    drift_m_per_sqrt_s: float = Field(default=0.005, ge=0.0)
    drift_per_m: float = Field(
        default=0.07, gt=0.0
    )  # reported: each metre adds so much of a match's covariance
    drift_per_m_guessed: float = Field(default=0.5, gt=0.0)  # ... where no wheels say how far
    drift_turn_m: float = Field(default=0.3, ge=0.0)  # ... and a radian as much as so many metres


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
        self._trust = WheelTrust(
            config.wheel_window_m,
            config.wheel_window_rad,
            config.wheel_scale_sigma,
            (config.drift_m_per_sqrt_m, config.drift_rad_per_sqrt_m),
        )
        self._lag = WheelLag(config.wheel_lag_sigma_s, config.wheel_jitter_s, config.wheel_most_lag_s)
        self._wheels_agree = SourceTrust(
            Noise(
                config.position_sigma_m,
                config.position_sigma_per_m,
                config.heading_sigma_rad,
                config.heading_sigma_per_rad,
                config.heading_sigma_per_m_rad,
            )
        )
        self._gyro_agrees = SourceTrust(
            Noise(math.inf, 0.0, config.gyro_sigma_rad, config.gyro_sigma_per_rad, 0.0)
        )
        self._walk = WheelWalk(
            config.drift_m_per_sqrt_m, config.drift_rad_per_sqrt_m, config.drift_m_per_sqrt_s
        )
        self._drift = MapDrift(config.drift_turn_m)
        self._last: tuple[int, Motion] | None = None
        self._predicted: Prediction | None = None
        self._rolled: SE2 | None = None  # what the wheels said of the way to the last prediction
        self._relative = np.zeros((3, 3))  # of the last pose, on the map
        self._wheel_speed: Twist | None = None  # at the last scan
        self._predicted_speed: Twist | None = None  # at the next
        self._was_matched = False  # the last scan
        self._wall_speed = (0.0, 0.0)  # m/s, rad/s that walls alone gave to the last step
        self._gyro_turn_rad: float | None = None  # to the last prediction
        self._pushed_ns: int | None = None  # when a match last was off where the wheels had stood
        self._has_speed = False  # two scans were matched, so their difference is a speed

    def add(self, sample: ImuSample | OdometrySample) -> bool:
        if isinstance(sample, OdometrySample):
            return self._odometry.add(sample)
        return self._gyro.add(sample)

    @property
    def complaint(self) -> str:
        said = []
        if not self._wheels_agree.is_trusted:
            said.append(
                f"the wheels contradict the walls ({self._wheels_agree.contradiction()} within a moment) and "
                "are left out; do they slip, is a sign wrong, is an encoder dead?"
            )
        if not self._gyro_agrees.is_trusted:
            said.append(
                f"the IMU's turns contradict the walls ({self._gyro_agrees.contradiction()} within a moment) "
                "and are left out; is it mounted upside down, is its unit rad/s, is its bias large?"
            )
        return "; ".join(said)

    def predict(self, stamp_ns: int) -> Prediction:
        self._predicted = self._first(stamp_ns) if self._last is None else self._next(stamp_ns, *self._last)
        return self._predicted

    def correct(self, stamp_ns: int, matched: Motion) -> Motion:
        predicted = self._predicted if self._predicted is not None else self._first(stamp_ns)
        is_match = matched.pose_odom_base != predicted.pose_odom_base or isinstance(matched, Matched)
        information = _information_of(matched) if is_match else UNKNOWN
        relative = on_the_map(information, predicted.step_covariance) if is_match else self._relative
        if self._last is not None:
            last_ns, last = self._last
            step = last.pose_odom_base.inverse() @ matched.pose_odom_base
            loss, per_m = self._loss(
                step, (stamp_ns - last_ns) * 1e-9, predicted.is_measured, predicted.step_covariance
            )
            if isinstance(matched, Matched) and matched.on_new_map:
                self._drift.add(self._relative)
            self._drift.advance(step, loss, information, per_m if is_match else 0.0)
            if is_match:
                away = predicted.pose_odom_base.inverse() @ matched.pose_odom_base
                if isinstance(matched, Matched):
                    pull = SE2(*matched.pull_base)
                    if predicted.is_measured:
                        self._notice_push(stamp_ns, away @ pull)
                    self._compare(last_ns, stamp_ns, step @ pull, information)
                if not predicted.is_measured or _sigmas(away, predicted.step_covariance) < SLIP_SIGMAS:
                    self._learn(last_ns, stamp_ns, step, relative)
                self._has_speed = True
            else:  # the map stays where it is, the pose on it grows vague
                relative = carried(relative, step) + np.diag(loss)
        self._relative, self._was_matched = relative, is_match
        self._wheel_speed = self._predicted_speed
        covariance = self._drift.covariance(self._trust.scale_sigma) + relative
        believed = replace(matched, covariance=covariance)
        self._last = (stamp_ns, believed)
        return believed

    def _next(self, stamp_ns: int, last_ns: int, last: Motion) -> Prediction:
        elapsed_s = (stamp_ns - last_ns) * 1e-9
        way = self._odometry.between(last_ns + self._lag.lag_ns, stamp_ns + self._lag.lag_ns)
        self._rolled = way.motion if way is not None else None
        self._predicted_speed = None
        if not self._wheels_agree.is_trusted:
            way = None
        if way is not None:
            step = self._trust.corrected(way.motion)
            twist = self._predicted_speed = self._wheel_twist(stamp_ns) or last.twist_base
            sigma_m, sigma_rad = self._wheel_sigmas(stamp_ns, step, twist, way.guessed_s)
        else:
            step, sigma_m, sigma_rad = self._coast(last.twist_base, elapsed_s)
            twist = last.twist_base
        turn_rad = self._gyro_turn_rad = self._gyro.turn_between(last_ns, stamp_ns)
        if turn_rad is not None and self._gyro_agrees.is_trusted:
            forward, left, _ = step.log()
            step = SE2.exp(forward, left, turn_rad)
            sigma_rad = self._config.gyro_sigma_rad + self._config.gyro_sigma_per_rad * abs(turn_rad)
            rate = self._gyro.rate_at(stamp_ns)
            twist = (twist[0], twist[1], rate if rate is not None else twist[2])
        step_covariance = np.diag([sigma_m**2, sigma_m**2, sigma_rad**2])
        loss, _ = self._loss(step, elapsed_s, way is not None, step_covariance)
        return Prediction(
            pose_odom_base=last.pose_odom_base @ step,
            twist_base=twist,
            covariance=carried(last.covariance, step) + np.diag(loss),
            step_covariance=step_covariance,
            elapsed_s=elapsed_s,
            twist_gain=1.0 - math.exp(-elapsed_s / self._config.twist_time_s),
            is_measured=way is not None,
        )

    def _wheel_twist(self, stamp_ns: int) -> Twist | None:
        twist = self._odometry.twist_at(stamp_ns + self._lag.lag_ns)
        if twist is None:
            return None
        return twist[0] * self._trust.scale, twist[1] * self._trust.scale, twist[2] * self._trust.turn_scale

    def _loss(
        self, step: SE2, elapsed_s: float, is_measured: bool, step_covariance: npt.NDArray[np.float64]
    ) -> tuple[npt.NDArray[np.float64], float]:
        """(3,) variances that dead reckoning loses over a step; how fast the map drifts meanwhile, 1/m."""
        if is_measured:
            return self._walk.over(step, elapsed_s), self._config.drift_per_m
        variances: npt.NDArray[np.float64] = np.maximum(np.diag(step_covariance), 1e-12)
        return variances, self._config.drift_per_m_guessed

    def _compare(self, last_ns: int, stamp_ns: int, step: SE2, information: npt.NDArray[np.float64]) -> None:
        """Hold what wheels and gyro said of a step against what the walls alone say."""
        forward_m, _, turn_rad = step.log()
        found = forward_m, turn_rad
        elapsed_s = (stamp_ns - last_ns) * 1e-9
        guessed = self._wall_speed[0] * elapsed_s, self._wall_speed[1] * elapsed_s
        self._wall_speed = forward_m / elapsed_s, turn_rad / elapsed_s
        match_sigma = _sigma_of(information[0, 0]), _sigma_of(information[2, 2])
        rolled = self._trust.corrected(self._rolled).log() if self._rolled is not None else None
        for source, said in (
            (self._wheels_agree, (rolled[0], rolled[2]) if rolled is not None else None),
            (self._gyro_agrees, (0.0, self._gyro_turn_rad) if self._gyro_turn_rad is not None else None),
        ):
            if said is None or not self._was_matched:
                source.begin_anew()
            else:
                source.learn(last_ns, stamp_ns, said, found, guessed, match_sigma)

    def _learn(self, last_ns: int, stamp_ns: int, step: SE2, relative: npt.NDArray[np.float64]) -> None:
        config = self._config
        self._gyro.learn_bias(last_ns, stamp_ns, step.theta_rad)
        if self._rolled is None or not self._wheels_agree.is_trusted:
            return
        sigma_m, sigma_rad = math.sqrt(relative[0, 0]), math.sqrt(relative[2, 2])
        if self._was_matched:
            self._lag.learn(
                last_ns, stamp_ns, step.theta_rad, sigma_rad, self._odometry, self._trust.turn_scale
            )
        self._trust.learn(
            self._rolled,
            step,
            sigma_m if sigma_m < config.wheel_learn_sigma_m else None,
            sigma_rad if sigma_rad < config.wheel_learn_sigma_rad else None,
        )

    def _first(self, stamp_ns: int) -> Prediction:
        twist = self._wheel_twist(stamp_ns) or STANDING
        nothing = np.zeros((3, 3))
        return Prediction(SE2(), twist, nothing, nothing, elapsed_s=0.0, twist_gain=0.0, is_measured=False)

    def _stands(self, stamp_ns: int, guessed_s: float) -> bool:
        """Whether wheels that stand still are believed: not while walls have lately said otherwise."""
        return guessed_s <= self._config.odometry_speed_window_s and (
            self._pushed_ns is None or stamp_ns - self._pushed_ns > PUSHED_NS
        )

    def _notice_push(self, stamp_ns: int, away: SE2) -> None:
        if (
            math.hypot(away.x_m, away.y_m) > PUSHED_SIGMAS * self._config.standing_sigma_m
            or abs(away.theta_rad) > PUSHED_SIGMAS * self._config.standing_sigma_rad
        ):
            self._pushed_ns = stamp_ns

    def _wheel_sigmas(self, stamp_ns: int, step: SE2, twist: Twist, guessed_s: float) -> tuple[float, float]:
        config = self._config
        d, a = math.hypot(step.x_m, step.y_m), abs(step.theta_rad)
        if self._stands(stamp_ns, guessed_s) and d <= STILL_M and a <= STILL_RAD:
            return config.standing_sigma_m, config.standing_sigma_rad
        guess = 0.5 * guessed_s**2
        before = self._wheel_speed or twist
        late_m = self._lag.sigma_s * math.hypot(twist[0] - before[0], twist[1] - before[1])
        late_rad = self._lag.sigma_s * abs(twist[2] - before[2])
        return (
            config.position_sigma_m
            + config.position_sigma_per_m * d
            + config.position_sigma_per_rad_m * a
            + config.acceleration_mps2 * guess
            + late_m,
            config.heading_sigma_rad
            + config.heading_sigma_per_rad * a
            + config.heading_sigma_per_m_rad * d
            + config.turn_acceleration_radps2 * guess
            + late_rad,
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


def _sigmas(away: SE2, covariance: npt.NDArray[np.float64]) -> float:
    """How far off, by a diagonal covariance."""
    offset = (away.x_m, away.y_m, away.theta_rad)
    return math.sqrt(sum(e * e / float(covariance[k, k]) for k, e in enumerate(offset)))


def _sigma_of(information: float) -> float:
    return 1.0 / math.sqrt(information) if information > 0.0 else math.inf


def _information_of(matched: Motion) -> npt.NDArray[np.float64]:
    """What a match says; one that does not tell it apart is taken at its covariance."""
    if isinstance(matched, Matched):
        return matched.information
    information = np.zeros((3, 3))
    invert_3x3(matched.covariance, information)
    return information
