"""The motion model: an error-state filter of pose, twist, odometry errors and gyro bias.

Model and equations: docs/estimator.md. Arithmetic: service/kernels/estimator.py.
"""

import logging
import math
from functools import partial

import numpy as np
from pydantic import Field

from drivers.frames import ImuSample, OdometrySample
from drivers.section import Section
from service.estimator.consistent_covariance import ConsistentCovariance
from service.estimator.motion import (
    PAUSE_NS,
    Matrix,
    Measurement,
    Motion,
    OdometryIncrement,
    Prediction,
    scan_alone,
)
from service.estimator.samples import Samples
from service.estimator.standstill import MAX_BRAKING_MPS2, Standstill, UnprovenStandstill
from service.estimator.wheel_slip import WheelSlip
from service.geometry import poses
from service.geometry.se2 import SE2, wrap_angle
from service.kernels.estimator import (
    add_scale_error,
    predict_motion,
    take_match,
    transfer_into_map,
)
from service.kernels.filter_state import (
    ACCELERATION,
    BIAS,
    FILTER,
    LAG,
    LOCAL_BLOCK,
    MAP_BLOCK,
    SCALE,
    STATES,
    TURN_SCALE,
    TWIST,
    MotionSettings,
)
from service.kernels.increments import MAX_SILENT_S
from service.kernels.source_noise import begin_motion
from service.kernels.sweep import begin_twist, deskew_sweep, motion_at
from service.kernels.tracks import SPEED_WINDOW_NS, Track
from service.outputs import NO_REASON, Reason

log = logging.getLogger(__name__)

# Factor on the modelled variance, 30 sigma: no noise but a fault, equal in all samples. The odometry of fr079
# reaches 580, that of csail 1150 where one sample is 46 deg late.
FAULT_NOISE = 1000.0
ACCELERATION_S = 0.2  # time constant of an acceleration: a drive reaches its speed in some tenths of a second
FADE_S = 1.0  # time constant of a speed that neither scans nor odometry confirm
NEW_GROUND_M = 0.5  # a rotation of a radian shows as much new ground as this path length
KEEP_BEFORE_NS = 2_000_000_000  # of samples before the last scan: for the largest lag, and for a speed
MAX_SPEED_MPS, MAX_TURN_RADPS = 30.0, 30.0  # of any vehicle: faster odometry has restarted
WARNING_INTERVAL_NS = 10_000_000_000
FIRST_TWIST_SIGMA = (1.0, 0.3, 0.5)  # m/s, m/s, rad/s at the first scan, without odometry
MIN_SIGMA = (1e-4, 1e-4, 1e-5)  # m, m, rad of the first pose against its own map


class EstimatorConfig(Section):
    """Noise of each motion source. A walk is a standard deviation that grows with the square root."""

    odometry_position_walk: float = Field(default=0.02, gt=0.0)  # m per root metre driven
    odometry_heading_walk: float = Field(default=0.01, gt=0.0)  # rad per root metre driven
    odometry_turn_walk: float = Field(default=0.02, gt=0.0)  # rad per root radian turned
    odometry_scale_sigma: float = Field(default=0.02, ge=0.0)  # of path length and rotation, prior
    odometry_lag_sigma_s: float = Field(default=0.05, ge=0.0)  # of its stamps, prior
    odometry_jitter_s: float = Field(default=0.01, ge=0.0)  # of each stamp
    gyro_walk: float = Field(default=0.002, gt=0.0)  # rad per root second
    gyro_bias_sigma_radps: float = Field(default=0.02, ge=0.0)
    acceleration: float = Field(default=1.0, gt=0.0)  # root of its density, m/s per root second
    turn_acceleration: float = Field(default=2.0, gt=0.0)  # rad/s per root second


class Estimator:
    """MotionModel. The odom frame is the base at the first scan."""

    def __init__(self, config: EstimatorConfig) -> None:
        self._settings = MotionSettings(
            position_walk=config.odometry_position_walk,
            heading_walk=config.odometry_heading_walk,
            turn_walk=config.odometry_turn_walk,
            resolution_m=2e-4,
            resolution_rad=1e-4,
            gyro_walk=config.gyro_walk,
            acceleration=config.acceleration,
            turn_acceleration=config.turn_acceleration,
            acceleration_s=ACCELERATION_S,
            jitter_s=config.odometry_jitter_s,
            fault_noise=FAULT_NOISE,
        )
        self._odometry, self._gyro = Samples(5), Samples(2)
        self._silent = Samples(5)  # odometry without samples
        self._gyro_rate = 0.0
        self._jump_reported_ns = 0  # next warning at the earliest
        self._still = Standstill()
        self._slip = WheelSlip()
        self._is_unconfirmed_stop = False  # as in Standstill, since the last scan
        self._consistent: ConsistentCovariance | None = None  # while only scans measure the motion; [31]
        self._standing: UnprovenStandstill | None = None  # while odometry has never moved; [30]
        sigma = np.zeros(STATES)
        sigma[LOCAL_BLOCK] = MIN_SIGMA
        sigma[TWIST : TWIST + 3] = FIRST_TWIST_SIGMA
        sigma[SCALE] = sigma[TURN_SCALE] = config.odometry_scale_sigma
        sigma[LAG], sigma[BIAS] = config.odometry_lag_sigma_s, config.gyro_bias_sigma_radps
        self._record = np.zeros(1, FILTER)
        self.filter: np.void = self._record[0]
        self.filter["settings"] = self._settings
        self.filter["covariance"] = np.diag(sigma**2)
        views = (self.filter[name] for name in ("pose", "twist", "noise", "increment", "covariance"))
        self._pose, self._twist, self._noise, self._newest_increment, self._covariance = views
        for noise in ("noise", "gyro_noise", "motion_noise"):
            self.filter[noise] = 1.0
        self._begin_acceleration()
        self._has_begun = False
        self._origin_ns: int | None = None
        self._elapsed_s = 0.0
        self._before = SE2()  # pose at the last scan

    @property
    def fault(self) -> Reason:
        """The source that contradicts the scans, with likely causes; NO_REASON where none does."""
        if self._still.is_stuck:
            return Reason(
                "odometry_stuck",
                "odometry contradicts the scans (it says the same position again while they move) and is not "
                "used; is an encoder dead, does its driver repeat its last message?",
            )
        distance, turns = self._noise.tolist()
        gyro = float(self.filter["gyro_noise"])
        if max(distance, turns) > FAULT_NOISE:
            source = "distance" if distance >= turns else "turns"
            return Reason(
                "odometry_contradicts",
                f"odometry contradicts the scans ({source} off by {math.sqrt(max(distance, turns)):.0f} "
                "times the noise of its model) and loses weight; do wheels slip, is a sign wrong, is an "
                "encoder dead?",
            )
        if gyro > FAULT_NOISE:
            return Reason(
                "imu_contradicts",
                f"the IMU's turns contradict the scans (off by {math.sqrt(gyro):.0f} times the noise of "
                "their model) and lose weight; is it mounted upside down, is its unit rad/s, is its "
                "bias large?",
            )
        return NO_REASON

    def add(self, sample: ImuSample | OdometrySample) -> bool:
        if isinstance(sample, OdometrySample):
            return self._add_odometry(sample)
        return self._add_gyro(sample)

    def begin_at(self, stamp_ns: int) -> None:
        self._origin_ns = stamp_ns

    def predict(self, stamp_ns: int) -> Prediction:
        state = self.filter
        before = self._before = SE2(*self._pose.tolist())
        pause_s = 0.0
        if not self._has_begun:
            self._has_begun = True
            self._begin(stamp_ns)
        else:
            self._elapsed_s = (stamp_ns - int(state["stamp_ns"])) * 1e-9
            if self._elapsed_s > PAUSE_NS * 1e-9:
                pause_s = self._used_odometry.longest_pause_s(int(state["stamp_ns"]), stamp_ns)
            self._predict(stamp_ns)
            if self._newest_increment["has_odometry"]:
                self._widen(self._slip.step(self._elapsed_s))
            used = self._used_odometry
            if pause_s > 0.0 and used.covered_ns(stamp_ns - PAUSE_NS, stamp_ns) >= SPEED_WINDOW_NS:
                self._begin_twist(stamp_ns)
        is_unconfirmed_stop, self._is_unconfirmed_stop = self._is_unconfirmed_stop, False
        self._odometry.drop_before(stamp_ns - KEEP_BEFORE_NS)
        self._gyro.drop_before(stamp_ns - KEEP_BEFORE_NS)
        noise, turn_noise = self._noise.tolist()
        is_measured = bool(self._newest_increment["has_odometry"]) and max(noise, turn_noise) <= FAULT_NOISE
        is_scan_alone = scan_alone(is_measured, noise)
        if is_scan_alone and self._consistent is None:
            self._consistent = ConsistentCovariance(self._record)
        elif not is_scan_alone and self._consistent is not None:
            self._consistent.add_excess_to(self._record)
            self._consistent = None
        until_ns = self._stands_until_ns(stamp_ns)
        if self._consistent is not None and until_ns is not None:
            if self._standing is None:
                self._standing = UnprovenStandstill(state, self._consistent.covariance.copy())
            self._standing.is_repeated = self._still.has_repeated
            self._standing.stand((stamp_ns - until_ns) * 1e-9, self._settings)
        samples_dropped = self._odometry.dropped + self._gyro.dropped
        self._odometry.dropped = self._gyro.dropped = 0
        covariance = self._covariance
        pose = SE2(*self._pose.tolist())
        return Prediction(
            pose_odom_base=pose,
            twist_base=tuple(self._twist.tolist()),
            covariance=self._covariances[-1][MAP_BLOCK, MAP_BLOCK].copy(),
            local_covariance=covariance[LOCAL_BLOCK, LOCAL_BLOCK].copy(),
            twist_covariance=covariance[TWIST : TWIST + 3, LOCAL_BLOCK].copy(),
            elapsed_s=self._elapsed_s,
            travel_m=math.hypot(pose.x_m - before.x_m, pose.y_m - before.y_m)
            + NEW_GROUND_M * abs(wrap_angle(pose.theta_rad - before.theta_rad)),
            is_measured=is_measured,
            is_standing=self._standing is not None and self._standing.is_repeated,
            odometry_noise=noise,
            pause_s=pause_s,
            is_unconfirmed_stop=is_unconfirmed_stop and pause_s > 0.0,
            increment=self._increment(),
            samples_dropped=samples_dropped,
            deskew=partial(deskew_sweep, self._record, *self._tracks),
        )

    @property
    def _used_odometry(self) -> Samples:
        """Of odometry that has never moved none is a measurement."""
        return self._silent if self._still.is_unproven else self._odometry

    @property
    def _tracks(self) -> tuple[Track, Track]:
        return self._used_odometry.track, self._gyro.track

    @property
    def _covariances(self) -> list[Matrix]:
        """The filter's and that propagated beside it; the last one is published."""
        return [self._covariance] + ([] if self._consistent is None else [self._consistent.covariance])

    def _stands_until_ns(self, stamp_ns: int) -> int | None:
        """Stamp of odometry's newest sample, if it works and has never moved."""
        last = self._odometry.last
        if last is None or not self._still.is_unproven or self._still.is_contradicted:
            return None
        newest_ns = int(self._odometry.track.stamp_ns[last])
        return newest_ns if stamp_ns - newest_ns < PAUSE_NS else None

    def _predict(self, stamp_ns: int) -> None:
        """Propagate state and covariances to the time of a scan."""
        if self._standing is not None and self._stands_until_ns(stamp_ns) is None:
            if self._standing.is_repeated and not self._still.is_unproven:  # it moves: until then it stood
                self._covariance[:] = self._standing.covariance
                self._consistent = None
                self._begin_twist(int(self.filter["stamp_ns"]))
            self._standing = None
        if self._consistent is not None:
            predict_motion(self._consistent.view(self._record), *self._tracks, stamp_ns)
        predict_motion(self._record, *self._tracks, stamp_ns)

    def _increment(self) -> OdometryIncrement | None:
        """The newest odometry increment, with the learnt noise, at least that of the model."""
        newest = self._newest_increment.item()
        has_odometry, _, has_gyro, step, variance_m2, turn_rad2, end_s3, gyro_rad, gyro_rad2 = newest
        if not has_odometry or self._elapsed_s <= 0.0:
            return None
        x_m, y_m, turn_rad = step.tolist()
        distance_noise, turn_noise = self._noise.tolist()
        turn_rad2 *= max(turn_noise, 1.0)
        end_m2 = self._settings.acceleration**2 * end_s3  # [8]
        end_rad2 = self._settings.turn_acceleration**2 * end_s3
        if has_gyro:  # it measures the rotation where odometry is extrapolated, too
            gyro_rad2 *= max(float(self.filter["gyro_noise"]), 1.0)
            share = (turn_rad2 + end_rad2) / (turn_rad2 + end_rad2 + gyro_rad2)
            turn_rad += share * wrap_angle(gyro_rad - turn_rad)
            turn_rad2, end_rad2 = share * gyro_rad2, 0.0
        return OdometryIncrement(
            SE2(x_m, y_m, turn_rad), variance_m2 * max(distance_noise, 1.0), turn_rad2, end_m2, end_rad2
        )

    def correct(self, measured: Measurement | None) -> Motion:
        state = self.filter
        if measured is not None and measured.gap is not None:
            state["path"]["span"] = 0  # matched elsewhere: this jump is no motion
            state["odometry_used"]["is_known"] = False
            self._widen(measured.gap)
        if measured is not None and measured.segment_noise is not None:
            for covariance in self._covariances:
                covariance[MAP_BLOCK, MAP_BLOCK] += measured.segment_noise
        if measured is not None and self._elapsed_s > 0.0:
            pose, covariance = measured.pose_odom_base, measured.covariance
            if not measured.is_joined:
                pose, covariance = self._joined(measured)
            if self._standing is not None and self._standing.is_repeated:
                standing = self._standing.joined(pose, covariance, measured.information)
                if standing is None:
                    self._standing, self._still.is_contradicted = None, True
                pose = standing or pose
            if self._consistent is not None:
                self._consistent.correct(self._record, pose, measured)
            weight, information = measured.prior_weight, measured.information
            take_match(self._record, np.array(pose), covariance, weight, information)
            if self._newest_increment["has_odometry"]:
                driven_m = float(self._newest_increment["step"][0])
                self._slip.compare(information, driven_m - self._before.between(pose).x_m)
        elif not self._newest_increment["has_odometry"]:
            self._twist *= math.exp(-self._elapsed_s / FADE_S)
        published = self._covariances[-1][MAP_BLOCK, MAP_BLOCK].copy()
        return Motion(SE2(*self._pose.tolist()), tuple(self._twist.tolist()), published)

    def moved(self, seconds: float) -> Motion:
        pose, twist, covariance = np.empty(3), np.empty(3), np.empty((3, 3))
        record = self._record if self._consistent is None else self._consistent.view(self._record)
        motion_at(record, *self._tracks, seconds, pose, twist, covariance)
        forward, left, turn = twist.tolist()
        if self._origin_ns == int(self.filter["stamp_ns"]) + round(seconds * 1e9):
            pose[:] = 0.0  # the origin of `odom`, without rounding errors
        return Motion(SE2(*pose.tolist()), (forward, left, turn), covariance)

    def _joined(self, measured: Measurement) -> tuple[SE2, Matrix]:
        """Weighted mean of the newest prediction and a pose by the scan alone, and its covariance."""
        predicted = SE2(*self.filter["pose"].tolist())
        prior = measured.prior_weight * np.linalg.inv(self.filter["covariance"][LOCAL_BLOCK, LOCAL_BLOCK])
        covariance = np.asarray(np.linalg.inv(prior + measured.information), np.float64)
        off = predicted.between(measured.pose_odom_base).log()
        step = SE2.exp(*(covariance @ measured.information @ off).tolist())
        axes = poses.adjoint(poses.between(np.array(step), np.zeros(3)))
        return predicted @ step, axes @ covariance @ axes.T

    def settle(self, share: float) -> None:
        for covariance in self._covariances:
            transfer_into_map(covariance, share)

    def _begin(self, stamp_ns: int) -> None:
        self._elapsed_s = 0.0
        begin_motion(self._record, stamp_ns)
        first, end = self._odometry.track.span.tolist()
        if end - first >= 2:
            self._begin_twist(stamp_ns)
        if self._origin_ns is not None:
            origin_ns, self._origin_ns = self._origin_ns, None
            origin = self.moved((origin_ns - stamp_ns) * 1e-9).pose_odom_base.inverse()
            self.filter["pose"] = origin.x_m, origin.y_m, origin.theta_rad
            self._origin_ns = origin_ns

    def _begin_twist(self, stamp_ns: int) -> None:
        """Set the twist to odometry's, at the first scan and after a pause; the old twist is discarded."""
        twist = np.zeros(3)
        begin_twist(self._odometry.track, stamp_ns, twist)
        state = self.filter
        state["twist"] = state["mean_twist"] = state["scale_twist"] = twist
        covariance = state["covariance"]
        covariance[TWIST : TWIST + 3, :] = 0.0
        covariance[:, TWIST : TWIST + 3] = 0.0
        for k in range(3):
            covariance[TWIST + k, TWIST + k] = 0.1**2
        add_scale_error(covariance, twist, 1.0, 0.0)
        self._begin_acceleration()

    def _begin_acceleration(self) -> None:
        """Reset the acceleration to zero with its prior covariance; [2]."""
        rows, covariance = slice(ACCELERATION, ACCELERATION + 3), self.filter["covariance"]
        self.filter["acceleration"] = 0.0
        covariance[rows, :] = 0.0
        covariance[:, rows] = 0.0
        density = np.square([self._settings.acceleration] * 2 + [self._settings.turn_acceleration])
        covariance[rows, rows] = np.diag(density / (2.0 * self._settings.acceleration_s))

    def _add_odometry(self, sample: OdometrySample) -> bool:
        own = sample.covariance
        value = (sample.x_m, sample.y_m, sample.theta_rad, own[0] + own[4], own[8])
        last = self._odometry.last
        if last is not None and sample.stamp_ns <= self._odometry.track.stamp_ns[last]:
            return False
        if not all(map(math.isfinite, value)):
            return False
        if last is not None:
            track = self._odometry.track
            if self._still.is_repeated(value[:3], track.value[last, :3], self.filter):
                if self._has_begun and self._still.is_uninformative(
                    sample.stamp_ns, track, self.filter, self._elapsed_s
                ):
                    self._is_unconfirmed_stop = self._still.is_unconfirmed_stop
                    return True
                value = (*track.value[last, :2].tolist(), *value[2:])  # without what rounding added
            else:
                step = poses.between(track.value[last, :3], np.array(value[:3]))
                hidden = self._still.hidden_motion(sample.stamp_ns, step, self.filter)
                # The motion while odometry was stuck is unknown.
                is_dead = self._still.is_stuck or self._still.is_unconfirmed_stop
                if self._still.is_contradicted or self._still.is_impossible_start(sample.stamp_ns, step):
                    is_dead, self._standing = True, None
                if is_dead or hidden is not None or self._has_restarted(sample, last):
                    self._begin_odometry()
                if hidden is not None:
                    self._catch_up(hidden)
                    log.warning(
                        "%s: odometry repeated its pose and now jumps by %.1f m and %.0f deg, of which the "
                        "scans have not measured %.1f m and %.0f deg; the pose follows. Does its driver "
                        "repeat the last message?",
                        sample.sensor, math.hypot(step[0], step[1]), abs(math.degrees(step[2])),
                        math.hypot(hidden[0], hidden[1]), abs(math.degrees(hidden[2])),
                    )  # fmt: skip
                self._still = Standstill(has_moved=True)
        self._odometry.append(sample.stamp_ns, value)
        if self._slip.add(self._odometry.track) and self._may_warn(sample.stamp_ns):
            log.warning(
                "%s: odometry's speed jumps by %+.1f m/s, faster than a vehicle accelerates (%.0f m/s^2); "
                "along a direction that scans leave open the pose is uncertain by it. Do wheels slip?",
                sample.sensor, self._slip.speed_mps, MAX_BRAKING_MPS2,
            )  # fmt: skip
        return True

    def _catch_up(self, hidden: Matrix) -> None:
        """Move the newest pose by a motion (3,) that odometry reports late; it may be off by as much."""
        state, gap = self.filter, np.outer(hidden, hidden)
        state["pose"] = poses.compose(state["pose"], hidden)
        state["path"]["span"] = 0
        state["odometry_used"]["is_known"] = False
        self._widen(gap)

    def _widen(self, gap: Matrix | None) -> None:
        """Add a covariance (3, 3), base axes, to the pose against the first scan and the local map."""
        if gap is None:
            return
        for covariance in self._covariances:
            for rows in (LOCAL_BLOCK, MAP_BLOCK):
                for columns in (LOCAL_BLOCK, MAP_BLOCK):
                    covariance[rows, columns] += gap

    def _begin_odometry(self) -> None:
        """Drop odometry's samples: the motion since the last one is unknown."""
        self._odometry.clear()
        self._slip = WheelSlip()
        self.filter["odometry_used"]["is_known"] = False

    def _may_warn(self, stamp_ns: int) -> bool:
        """Whether the last warning of a jump of odometry is WARNING_INTERVAL_NS ago."""
        if stamp_ns < self._jump_reported_ns:
            return False
        self._jump_reported_ns = stamp_ns + WARNING_INTERVAL_NS
        return True

    def _has_restarted(self, sample: OdometrySample, last: int) -> bool:
        """Whether odometry has jumped since the previous sample, as after a restart of the base's computer.

        The motion between the two samples is unknown: odometry counts as silent there.
        """
        x_m, y_m, theta_rad = self._odometry.track.value[last, :3].tolist()
        elapsed_s = (sample.stamp_ns - int(self._odometry.track.stamp_ns[last])) * 1e-9
        jump_m = math.hypot(sample.x_m - x_m, sample.y_m - y_m)
        jump_rad = abs(wrap_angle(sample.theta_rad - theta_rad))
        within_s = max(elapsed_s, MAX_SILENT_S)  # stamps of a burst are closer together than its samples
        if jump_m <= MAX_SPEED_MPS * within_s and jump_rad <= MAX_TURN_RADPS * within_s:
            return False
        if self._may_warn(sample.stamp_ns):
            log.warning(
                "%s: odometry jumps by %.1f m and %.0f deg within %.3f s (expected at most %.0f m/s and "
                "%.0f rad/s); it counts as restarted. Has the base restarted?",
                sample.sensor, jump_m, math.degrees(jump_rad), elapsed_s, MAX_SPEED_MPS, MAX_TURN_RADPS,
            )  # fmt: skip
        return True

    def _add_gyro(self, sample: ImuSample) -> bool:
        rate = sample.rate_radps[2]
        if not math.isfinite(rate):
            return False
        last = self._gyro.last
        if last is None:
            self._gyro.append(sample.stamp_ns, (0.0, 0.0))
        else:
            track = self._gyro.track
            elapsed_s = (sample.stamp_ns - int(track.stamp_ns[last])) * 1e-9
            if elapsed_s <= 0.0:
                return False
            turn = 0.5 * (rate + self._gyro_rate) * elapsed_s
            turned, missed = track.value[last].tolist()
            if elapsed_s > MAX_SILENT_S:  # [8] the rotation in a pause is interpolated between two rates
                missed += self._settings.turn_acceleration**2 * elapsed_s**3 / 12.0
            self._gyro.append(sample.stamp_ns, (turned + turn, missed))
        self._gyro_rate = rate
        return True
