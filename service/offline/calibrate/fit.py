"""Mountings, scales and time offsets by least squares, from the motions that two sensors saw.

Two sensors fixed on one vehicle measure the same motion, each at its own place: A X = X B, with X the
pose of one seen from the other. Of wheels and a laser the unknown scales of the wheels are estimated along
with X. Source: Censi, Franchi, Marchionni, Oriolo, Simultaneous calibration of odometry and sensor parameters
for mobile robots, IEEE Transactions on Robotics 29 (2013). To theirs come the time offset, and errors that
hang together from step to step: a pose that is off spoils the step before and the step after.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numpy.linalg import LinAlgError

from service.errors import InputError
from service.geometry.poses import Floats, between, compose, inverse
from service.offline.calibrate.tracks import GyroTrack, LaserTrack, WheelTrack, interpolated

KNOT_NS = 400_000_000  # a step; shorter ones are affected by the smoothing of a mapper's motion model
MIN_KNOTS = 40  # 16 s
ROUNDS = 12  # of Gauss and Newton, each with weights by what the last one left
DONE = 1e-4  # of its sigma: a change so small ends the rounds
MAX_OFFSET_S = 0.25
MAX_SIGMAS = 4.0  # a step that lies further off counts less (Huber)
JACOBIAN_STEPS = {"m": 1e-4, "rad": 1e-4, "s": 1e-3, "1": 1e-4, "rad/s": 1e-4, "rad/m": 1e-4}
# One sigma of what is thought before: so weak that a drive outweighs it; what a drive leaves open stays put
BELIEVED = {"m": 1.0, "rad": 3.0, "s": 0.1, "1": 0.3, "rad/s": 0.1, "rad/m": 0.05}


@dataclass(frozen=True, slots=True)
class Unknown:
    name: str
    unit: str  # a key of JACOBIAN_STEPS
    start: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Result: values and their covariance."""

    names: tuple[str, ...]
    values: Floats  # (P,)
    covariance: Floats  # (P, P)

    def __getitem__(self, name: str) -> float:
        return float(self.values[self.names.index(name)])

    def sigma(self, name: str) -> float:
        k = self.names.index(name)
        return math.sqrt(max(float(self.covariance[k, k]), 0.0))


def fit_wheels(laser: LaserTrack, wheels: WheelTrack, wheel_base_m: float | None) -> Fit:
    """x_m, y_m, yaw_rad: pose_base_laser; scale, turn_scale, turn_per_m of the wheels; offset_s.

    wheel_base_m   as configured: unequal wheels then cost distance in turns, too; None: that is left out
    offset_s       by how much the wheels' stamps are late against the laser's

    Raises InputError where both hardly overlap or nothing was driven.
    """
    knots = _knots(laser, wheels.stamp_ns)
    at_knots = laser.at(knots)
    seen = _relative(at_knots)
    counted = _relative(interpolated(knots, wheels.stamp_ns, wheels.poses(1, 1, 0, 0)))

    def residuals(p: Floats) -> Floats:
        scale, turn_scale, turn_per_m, offset_s = p[3:]
        lost = 0.0 if wheel_base_m is None else turn_per_m * scale * wheel_base_m**2 / (4.0 * turn_scale)
        base = wheels.poses(scale, turn_scale, turn_per_m, lost)
        moved = interpolated(knots + offset_s * 1e9, wheels.stamp_ns, base)
        return between(seen, _relative(compose(moved, p[:3])))

    if float(np.ptp(at_knots[:, 2])) == 0.0 and not wheels.steps.any():
        raise InputError(f"{wheels.sensor}: the wheels never moved; drive, and turn to both sides")
    motion = np.abs(counted)
    unknowns = (
        Unknown("x_m", "m"),
        Unknown("y_m", "m"),
        Unknown("yaw_rad", "rad", _turn_between(seen, counted)),
        Unknown("scale", "1", 1.0),
        Unknown("turn_scale", "1", 1.0),
        Unknown("turn_per_m", "rad/m"),
        Unknown("offset_s", "s"),
    )
    return _solve(unknowns, residuals, np.hypot(motion[:, 0], motion[:, 1]) + 0.1 * motion[:, 2])


def fit_gyro(laser: LaserTrack, gyro: GyroTrack) -> Fit:
    """scale (true turn / turn felt), bias_radps of what is felt, offset_s: by how much its stamps are late.

    Raises InputError where both hardly overlap.
    """
    knots = _knots(laser, gyro.stamp_ns)
    seen = np.diff(laser.at(knots)[:, 2])
    duration_s = np.diff(knots) * 1e-9
    felt = np.diff(np.interp(knots, gyro.stamp_ns, gyro.turn_rad))
    start = -1.0 if float(seen @ felt) < 0.0 else 1.0  # upside down

    def residuals(p: Floats) -> Floats:
        scale, bias_radps, offset_s = p
        turn = np.diff(np.interp(knots + offset_s * 1e9, gyro.stamp_ns, gyro.turn_rad))
        off: Floats = scale * (turn - bias_radps * duration_s) - seen
        return off[:, None]

    unknowns = (Unknown("scale", "1", start), Unknown("bias_radps", "rad/s"), Unknown("offset_s", "s"))
    return _solve(unknowns, residuals, duration_s)


def fit_lasers(laser: LaserTrack, other: LaserTrack) -> Fit:
    """x_m, y_m, yaw_rad: pose_laser_other; offset_s: by how much the other's stamps are late.

    Raises InputError where both hardly overlap.
    """
    knots = _knots(laser, other.stamp_ns)
    seen = _relative(laser.at(knots))

    def residuals(p: Floats) -> Floats:
        pose_other_laser = inverse(p[:3])
        return between(seen, _relative(compose(other.at(knots + p[3] * 1e9), pose_other_laser)))

    yaw = _turn_between(_relative(other.at(knots)), seen)
    unknowns = (
        Unknown("x_m", "m"),
        Unknown("y_m", "m"),
        Unknown("yaw_rad", "rad", yaw),
        Unknown("offset_s", "s"),
    )
    return _solve(unknowns, residuals, np.full(len(seen), 1e-6))


def _knots(laser: LaserTrack, other_ns: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Stamps of scans KNOT_NS apart, where the other one was awake, with room for a time offset."""
    room_ns = round(MAX_OFFSET_S * 1e9)
    inside = (laser.stamp_ns > other_ns[0] + room_ns) & (laser.stamp_ns < other_ns[-1] - room_ns)
    knots: list[int] = []
    for stamp_ns in laser.stamp_ns[inside].tolist():
        if not knots or stamp_ns - knots[-1] >= KNOT_NS:
            knots.append(stamp_ns)
    if len(knots) < MIN_KNOTS:
        raise InputError(
            f"{laser.sensor}: {len(knots) * KNOT_NS / 1e9:.0f} s together with the sensor it is compared "
            f"with; expected {MIN_KNOTS * KNOT_NS / 1e9:.0f} s or more"
        )
    return np.array(knots, dtype=np.int64)


def _relative(pose: Floats) -> Floats:
    """(N, 3) poses -> (N - 1, 3) each seen from the one before."""
    return between(pose[:-1], pose[1:])


def _turn_between(from_steps: Floats, to_steps: Floats) -> float:
    """The angle that best turns straight steps of one onto those of the other."""
    straight = np.abs(to_steps[:, 2]) < 0.02
    a, b = from_steps[straight, :2], to_steps[straight, :2]
    return math.atan2(float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()), float((a * b).sum()))


def _solve(unknowns: Sequence[Unknown], residuals: Callable[[Floats], Floats], path_m: Floats) -> Fit:
    """Gauss and Newton with weights. Raises InputError where the numbers make no sense.

    path_m  (N,) of each step: the variance of a step is q * path + 2 r^2, and neighbours share -r^2, with q
            the noise that grows with the distance and r that of a pose; both are read off the residuals
    """
    start = np.array([unknown.start for unknown in unknowns])
    believed = np.array([BELIEVED[unknown.unit] for unknown in unknowns]) ** -2.0
    p = start.copy()
    deltas = np.array([JACOBIAN_STEPS[unknown.unit] for unknown in unknowns])
    weigh = np.ones(len(path_m))
    covariance: Floats = np.eye(len(p))
    for _ in range(ROUNDS):
        r = residuals(p)
        jacobian = np.stack([(residuals(p + d) - residuals(p - d)) for d in np.diag(deltas)], axis=2)
        jacobian /= 2.0 * deltas
        information, pull = np.diag(believed), believed * (p - start)
        off = np.zeros(len(path_m))
        for component in range(r.shape[1]):
            whitened_j, whitened_r = _whiten(jacobian[:, component], r[:, component], path_m, weigh)
            information += whitened_j.T @ whitened_j
            pull += whitened_j.T @ whitened_r
            off = np.maximum(off, np.abs(whitened_r))
        try:
            covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
        except LinAlgError as error:
            raise InputError("what both sensors saw of the drive does not fit together") from error
        change = -covariance @ pull
        p = p + change
        weigh = np.where(off > MAX_SIGMAS, off / MAX_SIGMAS, 1.0)
        if (np.abs(change) < DONE * np.sqrt(np.diag(covariance))).all():
            break
    return Fit(tuple(u.name for u in unknowns), p, covariance)


def _whiten(jacobian: Floats, r: Floats, path_m: Floats, weigh: Floats) -> tuple[Floats, Floats]:
    """Both multiplied by the inverse of the Cholesky factor of the residuals' covariance, which has three
    diagonals."""
    pose_variance, path_noise = _noise(r, path_m)
    diagonal = (path_noise * path_m + 2.0 * pose_variance) * weigh**2
    beside = -pose_variance * np.ones(len(r) - 1)
    lower = np.empty(len(r))
    factor = np.zeros(len(r))
    for k in range(len(r)):
        lower[k] = math.sqrt(max(diagonal[k] - factor[k] ** 2, 1e-4 * diagonal[k]))
        if k + 1 < len(r):
            factor[k + 1] = beside[k] / lower[k]
    table = np.column_stack((jacobian, r))
    white = np.empty_like(table)
    last = np.zeros(table.shape[1])
    for k in range(len(r)):
        last = (table[k] - factor[k] * last) / lower[k]
        white[k] = last
    return white[:, :-1], white[:, -1]


def _noise(r: Floats, path_m: Floats) -> tuple[float, float]:
    """Variance of a pose, and variance a metre, by the scatter of steps and of their neighbours."""
    spread = float(np.median(np.abs(r))) / 0.6745
    core = np.clip(r, -MAX_SIGMAS * spread, MAX_SIGMAS * spread) if spread else r
    core = core - core.mean()
    variance = float(core @ core) / len(core)
    pose_variance = min(max(-float(core[1:] @ core[:-1]) / (len(core) - 1), 1e-3 * variance), 0.5 * variance)
    path_noise = max(variance - 2.0 * pose_variance, 1e-3 * variance) / max(float(path_m.mean()), 1e-12)
    return max(pose_variance, 1e-16), max(path_noise, 1e-12)
