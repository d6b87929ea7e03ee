"""Odometry that repeats a pose: the vehicle stands, or the encoder or its driver has failed; [30].

By its model a dead encoder measures standstill more precisely than any other source. The same pose is used
only from odometry that has moved before, or moves later, and after a stop that a vehicle can make or that
scans confirm. Odometry that stood while the vehicle moved is used again once its pose changes. The same holds
of a position that repeats while the heading changes: a gyro may measure that, or the vehicle turns on the
spot.
"""

import math
from dataclasses import dataclass

import numpy as np

from service.estimator.motion import Matrix
from service.geometry import poses
from service.geometry.chi2 import CHI2_99999_OF_3
from service.geometry.se2 import SE2, wrap_angle
from service.kernels.filter_state import LOCAL_BLOCK, MAP_BLOCK, TWIST, MotionSettings
from service.kernels.increments import STANDING_M, STANDING_RAD
from service.kernels.tracks import Track

ROUNDING = 1e-9  # m and rad, by filters and changes of frame, within some 1000 km of the origin
# Speed at standstill, 1 sigma; a vehicle that moves is faster by so many sigmas.
STANDSTILL_SIGMA, MOVING_SIGMAS = (0.01, 0.01, 0.01), 5.0  # m/s, m/s, rad/s
MAX_BRAKING_MPS2, MAX_TURN_BRAKING_RADPS2 = 5.0, 20.0  # of a vehicle that stops by itself
# Odometry that stands so long, or so far, while the vehicle moves is stuck.
STUCK_NS, STUCK_M, STUCK_RAD = 1_000_000_000, 0.1, 0.1
MISSED_SCANS = 5  # and more than STUCK_NS: the laser is silent


@dataclass(frozen=True, slots=True)
class _ImpossibleStop:
    """Odometry stops between two samples, faster than a vehicle brakes."""

    speed_mps: float  # before; 0: the vehicle can have stopped from it
    turn_radps: float  # likewise
    pose: Matrix  # (3,) at the last scan before
    path_length_m: float  # from there to the stop, by odometry
    turn_rad: float


@dataclass(frozen=True, slots=True)
class _Begin:
    """When odometry began to repeat a pose."""

    stamp_ns: int  # of the first sample with this pose
    scan_ns: int  # of the last scan
    pose: Matrix  # (3,) at that scan
    speed_mps: float  # by odometry, before
    turn_radps: float


@dataclass(slots=True)
class Standstill:
    """Call `is_uninformative` with each sample that `is_repeated`; another pose begins a new Standstill."""

    has_moved: bool = False  # at least once
    has_repeated: bool = False  # to the last bit, at least once
    is_contradicted: bool = False  # by a scan, before odometry has moved
    is_stuck: bool = False  # odometry stands while the vehicle moves
    is_unconfirmed_stop: bool = False  # odometry stopped faster than a vehicle brakes; no scan confirms it
    _is_turning: bool = False  # the heading changes, the position does not
    _since_ns: int | None = None  # stamp of the first repeated sample
    _newest_ns: int = 0  # stamp of the newest one
    _begin: _Begin | None = None
    _stop: _ImpossibleStop | None = None  # until a scan confirms it

    def is_repeated(self, pose: tuple[float, float, float], last: Matrix, state: np.void) -> bool:
        """Whether a sample repeats the last pose (3,): to the last bit, or but for rounding, or but for the
        heading, while the vehicle moves.
        """
        x_m, y_m, theta_rad = (pose - last).tolist()
        self._is_turning = abs(theta_rad) >= ROUNDING
        if x_m == y_m == theta_rad == 0.0:
            self.has_repeated = True
        elif math.hypot(x_m, y_m) >= ROUNDING or not (self.is_stuck or self._is_moving(state)):
            return False
        return True

    def is_uninformative(self, stamp_ns: int, track: Track, state: np.void, period_s: float) -> bool:
        """Whether such a sample is no evidence of standstill.

        track      of odometry, up to the sample that was used last
        state      as of the last scan
        period_s   of the scans
        """
        scan_ns = int(state["stamp_ns"])
        is_scan_missing = stamp_ns - scan_ns > STUCK_NS
        if is_scan_missing and stamp_ns - scan_ns <= MISSED_SCANS * period_s * 1e9:
            return False  # no scan is expected yet
        self._newest_ns = stamp_ns
        if self._since_ns is None:
            self._since_ns = stamp_ns
            self._begin = _begin(track, state)
            self._stop = _impossible_stop(stamp_ns, track, state, self._is_turning)
        if is_scan_missing:
            self.is_unconfirmed_stop = self._stop is not None
            return self.is_unconfirmed_stop
        self.is_unconfirmed_stop = False
        if self._stop is not None and _moved_farther(self._stop, state):
            self.is_stuck = True
        if self._stop is not None and not _keeps_speed(self._stop, state):
            self._stop = None
        if scan_ns - self._since_ns > STUCK_NS and (self._stop is not None or self._is_moving(state)):
            self.is_stuck = True
        return self.is_stuck or self.is_contradicted or self._stop is not None

    @property
    def is_unproven(self) -> bool:
        """Whether odometry has stood since it was heard first, as with a dead encoder."""
        return not (self.has_moved or self._is_turning)

    def is_impossible_start(self, stamp_ns: int, step: Matrix) -> bool:
        """Whether odometry that has never moved begins with a step (3,), m, m, rad, that no vehicle makes."""
        jump_m, jump_rad = math.hypot(step[0], step[1]), abs(float(step[2]))
        is_jump = jump_m > STUCK_M or jump_rad > STUCK_RAD
        return self.is_unproven and is_jump and not self._starts(stamp_ns, jump_m, jump_rad)

    def hidden_motion(self, stamp_ns: int, step: Matrix, state: np.void) -> Matrix | None:
        """(3,) m, m, rad, base axes: motion in this standstill that the scans did not measure; else None.

        stamp_ns   of the sample that ends the standstill
        step       (3,) to its pose
        state      as of the last scan

        A driver may repeat a message while the encoder counts on. Then odometry jumps faster than a vehicle
        starts, about as far as it drives at its speed before; a dead encoder has counted nothing.
        """
        begin = self._begin
        if begin is None:
            return None
        jump_m, jump_rad = math.hypot(step[0], step[1]), abs(float(step[2]))
        elapsed_s = (stamp_ns - begin.stamp_ns) * 1e-9
        expected, jump = elapsed_s * (begin.speed_mps + begin.turn_radps), jump_m + jump_rad
        if self._starts(stamp_ns, jump_m, jump_rad) or not 0.5 * expected <= jump <= 2.0 * expected:
            return None
        hidden = poses.between(poses.between(begin.pose, state["pose"]), step)
        apart_s = (abs(begin.stamp_ns - begin.scan_ns) + abs(stamp_ns - int(state["stamp_ns"]))) * 1e-9
        if 4.0 * apart_s > elapsed_s:  # scans too far apart to tell
            return None
        is_hidden = math.hypot(hidden[0], hidden[1]) > STUCK_M + apart_s * begin.speed_mps
        return hidden if is_hidden or abs(hidden[2]) > STUCK_RAD + apart_s * begin.turn_radps else None

    def _starts(self, stamp_ns: int, jump_m: float, jump_rad: float) -> bool:
        """Whether a vehicle can move so far from standstill, since the newest repeated sample."""
        start_s = (stamp_ns - self._newest_ns) * 1e-9
        return jump_m <= MAX_BRAKING_MPS2 * start_s**2 and jump_rad <= MAX_TURN_BRAKING_RADPS2 * start_s**2

    def _is_moving(self, state: np.void) -> bool:
        """Whether the speed at the last scan (that ahead if the heading changes) is significant."""
        variance = np.diag(state["covariance"])[TWIST : TWIST + 3] + np.square(STANDSTILL_SIGMA)
        is_moving = np.square(state["twist"]) > MOVING_SIGMAS**2 * variance
        return bool(is_moving[0] if self._is_turning else is_moving.any())


class UnprovenStandstill:
    """Where a vehicle stands by odometry that has never moved: a prior of its matches; its covariance is the
    estimator's once odometry moves.
    """

    def __init__(self, state: np.void, covariance: Matrix) -> None:
        """covariance: (22, 22) of the errors of the estimator's state, when odometry was heard first."""
        self._pose, self._covariance = SE2(*state["pose"].tolist()), covariance
        self._motion: Matrix = np.zeros((3, 3))  # covariance of that since then, base axes
        self.is_repeated = False  # odometry has said so at least twice

    def stand(self, silent_s: float, settings: MotionSettings) -> None:
        """Stand until a scan, which comes so long after odometry's newest sample."""
        q = np.array([settings.acceleration, settings.acceleration, settings.turn_acceleration]) ** 2
        still = np.array([STANDING_M, STANDING_M, STANDING_RAD]) ** 2
        self._motion = np.diag(still + q * max(silent_s, 0.0) ** 3 / 3.0)  # [8]

    def joined(self, pose: SE2, covariance: Matrix, information: Matrix) -> SE2 | None:
        """A pose by the scans and this place together; None: it contradicts that the vehicle stands.

        covariance    (3, 3) of the pose
        information   (3, 3) of the newest scan alone
        """
        off = np.array(pose.between(self._pose).log())
        own = self.covariance[LOCAL_BLOCK, LOCAL_BLOCK]
        weighted = np.linalg.solve(covariance + own, off)
        if off @ weighted > CHI2_99999_OF_3:
            return None
        self._motion = np.asarray(np.linalg.inv(np.linalg.inv(self._motion) + information), np.float64)
        return pose @ SE2.exp(*(covariance @ weighted).tolist())

    @property
    def covariance(self) -> Matrix:
        """(22, 22) of the errors at the newest scan."""
        covariance = self._covariance.copy()
        for rows in (LOCAL_BLOCK, MAP_BLOCK):
            for columns in (LOCAL_BLOCK, MAP_BLOCK):
                covariance[rows, columns] += self._motion
        return covariance


def _begin(track: Track, state: np.void) -> _Begin | None:
    first, end = track.span.tolist()
    if end - first < 2:
        return None
    before_ns, stamp_ns = track.stamp_ns[end - 2 : end].tolist()
    x_m, y_m, theta_rad = (track.value[end - 1, :3] - track.value[end - 2, :3]).tolist()
    elapsed_s = (stamp_ns - before_ns) * 1e-9
    speed_mps, turn_radps = math.hypot(x_m, y_m) / elapsed_s, abs(wrap_angle(theta_rad)) / elapsed_s
    return _Begin(stamp_ns, int(state["stamp_ns"]), state["pose"].copy(), speed_mps, turn_radps)


def _keeps_speed(stop: _ImpossibleStop, state: np.void) -> bool:
    """Whether the speed by the scans is closer to that before the stop than to zero."""
    forward, left, turn = state["twist"].tolist()
    keeps_speed = 2.0 * math.hypot(forward, left) > stop.speed_mps > 0.0
    return keeps_speed or 2.0 * abs(turn) > stop.turn_radps > 0.0


def _moved_farther(stop: _ImpossibleStop, state: np.void) -> bool:
    """Whether the scans moved farther since then than odometry reports."""
    x_m, y_m, theta_rad = poses.between(stop.pose, state["pose"]).tolist()
    is_farther = math.hypot(x_m, y_m) > stop.path_length_m + STUCK_M
    return is_farther or abs(theta_rad) > stop.turn_rad + STUCK_RAD


def _impossible_stop(stamp_ns: int, track: Track, state: np.void, is_turning: bool) -> _ImpossibleStop | None:
    """The impossible stop at odometry's newest sample; None: a vehicle can have stopped so.

    Both of the last two steps are tested, because odometry may have stood for part of the last one.

    stamp_ns   of the first repeated sample
    """
    first, end = track.span.tolist()
    last_ns = int(track.stamp_ns[end - 1])
    for k in range(end - 2, max(end - 4, first - 1), -1):
        x_m, y_m, theta_rad = (track.value[k + 1, :3] - track.value[k, :3]).tolist()
        elapsed_s = (int(track.stamp_ns[k + 1]) - int(track.stamp_ns[k])) * 1e-9
        stopped_s = max(last_ns - int(track.stamp_ns[k]), stamp_ns - last_ns) * 1e-9
        speed_mps, turn_radps = math.hypot(x_m, y_m) / elapsed_s, abs(wrap_angle(theta_rad)) / elapsed_s
        brakes = speed_mps <= MAX_BRAKING_MPS2 * stopped_s
        brakes_turn = is_turning or turn_radps <= MAX_TURN_BRAKING_RADPS2 * stopped_s
        if brakes and brakes_turn:
            continue
        lead_s = max((last_ns - int(state["stamp_ns"])) * 1e-9, 0.0)
        return _ImpossibleStop(
            speed_mps=0.0 if brakes else speed_mps,
            turn_radps=0.0 if brakes_turn else turn_radps,
            pose=state["pose"].copy(),
            path_length_m=speed_mps * lead_s,
            turn_rad=math.inf if is_turning else turn_radps * lead_s,
        )
    return None
