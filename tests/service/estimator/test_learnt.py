"""What the estimator learns of odometry on drives with noise: right within what it believes, no more."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from service.estimator.estimator import ACCELERATION_S, Estimator, EstimatorConfig
from service.estimator.motion import Measurement
from service.geometry.se2 import SE2
from service.kernels.filter_state import LAG, SCALE, TURN_SCALE
from tests.service.estimator.samples import gyro, matched, odometry
from tests.simulated import Wheels
from tests.soaked import in_soak

DT_S = 1e-3
SCAN_S, ODOMETRY_S = 0.02, 0.015
SETTLE_M = 0.1
SIGMA_M, SIGMA_RAD = 1e-3, 3e-4  # of a scan
EVERYWHERE = (SIGMA_M**-2, SIGMA_M**-2, SIGMA_RAD**-2)  # 1/m^2, 1/m^2, 1/rad^2
CORRIDOR = (0.0, SIGMA_M**-2, SIGMA_RAD**-2)  # nothing along the walls, which lie along x
SEEDS = (0, 1, 2)
FEW_SEEDS = [0, in_soak(1), in_soak(2)]


@dataclass(frozen=True)
class FaultyWheels(Wheels):
    """Odometry whose stamps lag, that slips or that dies."""

    lag_s: float = 0.0
    slip_radps: float = 0.0  # for 0.7 s, 8 s after the start
    dies_s: float = math.inf  # reports standstill from then on


def one_seed(*cases: FaultyWheels) -> list[Any]:
    """Each with the first seed, with the others in `make soak`."""
    return [(case, seed) if seed == SEEDS[0] else in_soak(case, seed) for case in cases for seed in SEEDS]


@dataclass(frozen=True)
class Learnt:
    """Errors of scale, turn scale and lag (s), what the estimator believes of them, and the last pose's."""

    error: npt.NDArray[np.float64]
    sigma: npt.NDArray[np.float64]
    along_m: float

    @property
    def over_sigma(self) -> npt.NDArray[np.float64]:
        return np.abs(self.error) / self.sigma


def turn_rate_radps(t_s: npt.NDArray[np.float64], has_corners: bool) -> npt.NDArray[np.float64]:
    """A corner of 90 deg within 2 s, each 8 s."""
    phase_s = t_s % 8.0
    is_corner = has_corners & (phase_s > 5.0) & (phase_s < 7.0)
    return np.where(is_corner, 0.5 * math.pi * np.sin(0.5 * math.pi * (phase_s - 5.0)) ** 2, 0.0)


def learnt_on(
    seed: int, seconds: float, information: tuple[float, ...], wheels: FaultyWheels, has_corners: bool = False
) -> Learnt:
    noise = np.random.default_rng(seed)
    t_s = np.arange(0.0, seconds + 0.1, DT_S)
    speed_mps = np.minimum(t_s, 1.0) * (1.0 + 0.05 * np.sin(2.0 * math.pi * t_s / 7.0 + seed))
    path_m = np.cumsum(speed_mps) * DT_S
    heading_rad = np.cumsum(turn_rate_radps(t_s, has_corners)) * DT_S
    x_m = np.cumsum(speed_mps * np.cos(heading_rad)) * DT_S
    y_m = np.cumsum(speed_mps * np.sin(heading_rad)) * DT_S

    rows = np.arange(0, len(t_s), round(ODOMETRY_S / DT_S))
    steps_m = np.diff(path_m[rows], prepend=0.0)
    root = np.sqrt(steps_m) * noise.standard_normal((2, len(rows)))
    slip_rad = wheels.slip_radps * ODOMETRY_S * ((t_s[rows] > 8.0) & (t_s[rows] < 8.7))
    turned_rad = wheels.turn_scale * np.diff(heading_rad[rows], prepend=0.0)
    turned_rad += wheels.sigma_rad_per_sqrt_m * root[1] + slip_rad
    turned_rad = np.where(t_s[rows] < wheels.dies_s, turned_rad, 0.0)
    odometry_rad = np.cumsum(turned_rad)
    odometry_m = np.where(
        t_s[rows] < wheels.dies_s, wheels.scale * steps_m + wheels.sigma_m_per_sqrt_m * root[0], 0.0
    )
    odometry_x_m = np.cumsum(odometry_m * np.cos(odometry_rad - 0.5 * turned_rad))
    odometry_y_m = np.cumsum(odometry_m * np.sin(odometry_rad - 0.5 * turned_rad))

    model, along_map, settled_m, sent = Estimator(EstimatorConfig()), np.diag(information), 0.0, 0
    root_information = np.sqrt(np.where(along_map > 0.0, 1.0 / np.maximum(along_map, 1e-9), 0.0))
    for k in range(round(0.2 / DT_S), len(t_s), round(SCAN_S / DT_S)):
        while sent < len(rows) and rows[sent] <= k + round(SCAN_S / DT_S):
            stamp_ms = 1e3 * (t_s[rows[sent]] + wheels.lag_s) + 1000.0
            model.add(odometry(stamp_ms, SE2(odometry_x_m[sent], odometry_y_m[sent], odometry_rad[sent])))
            sent += 1
        predicted = model.predict(round((t_s[k] + 1.0) * 1e9))
        true = SE2(x_m[k], y_m[k], heading_rad[k])
        if k == round(0.2 / DT_S):
            first = true
        true = first.inverse() @ true
        turn = 0.0 if has_corners else -predicted.pose_odom_base.theta_rad
        c, s = math.cos(turn), math.sin(turn)
        axes = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])  # of the walls, in the base
        seen = true @ SE2.exp(*(axes @ root_information @ noise.standard_normal(3)).tolist())
        of_scan = axes @ along_map @ axes.T
        off = np.array((predicted.pose_odom_base.inverse() @ seen).log())
        prior = np.linalg.inv(predicted.local_covariance)
        moved = np.linalg.solve(prior + of_scan, of_scan @ off)  # to where the scan is matched
        chi2 = float(moved @ prior @ moved)
        weight = min(1.0, 8.0 / (5.0 + chi2))  # as the matcher weighs a prediction, [12]
        motion = model.correct(Measurement(seen, np.eye(3), of_scan, weight, is_joined=False))
        if path_m[k] - settled_m > SETTLE_M:
            model.settle(math.exp(-SETTLE_M / 4.0))
            settled_m = path_m[k]
    truth = np.array([1.0 / wheels.scale - 1.0, 1.0 / wheels.turn_scale - 1.0, wheels.lag_s])
    sigma = np.sqrt(np.diag(model.filter["covariance"])[[SCALE, TURN_SCALE, LAG]])
    learnt = np.array([model.filter[name] for name in ("scale", "turn_scale", "lag_s")])
    return Learnt(learnt - truth, sigma, motion.pose_odom_base.x_m - true.x_m)


@pytest.mark.parametrize("seed", FEW_SEEDS)
def test_a_corridor_teaches_no_scale(seed: int) -> None:
    """Errors of scale and speed are indistinguishable there: noise must not seem to separate them."""
    learnt = learnt_on(seed, 30.0, CORRIDOR, FaultyWheels())
    assert abs(learnt.error[0]) < 1e-3
    assert learnt.sigma[0] == pytest.approx(EstimatorConfig().odometry_scale_sigma, rel=0.01)
    assert abs(learnt.along_m) < 3.0 * 0.01 * math.sqrt(30.0)


@pytest.mark.parametrize("seed", FEW_SEEDS)
def test_a_straight_path_teaches_neither_turn_scale_nor_lag(seed: int) -> None:
    learnt = learnt_on(seed, 30.0, EVERYWHERE, FaultyWheels())
    assert (learnt.over_sigma < 3.0).all()
    assert (learnt.sigma[1:] > 0.5 * np.array([0.02, 0.05])).all()


@pytest.mark.parametrize(
    ("wheels", "seed"),
    one_seed(FaultyWheels(), FaultyWheels(scale=0.95, turn_scale=1.05), FaultyWheels(lag_s=0.03)),
)
def test_corners_teach_what_is_true(wheels: FaultyWheels, seed: int) -> None:
    learnt = learnt_on(seed, 48.0, EVERYWHERE, wheels, has_corners=True)
    assert (learnt.over_sigma < 3.0).all()
    assert (learnt.sigma < (0.003, 0.007, 0.004)).all()


@pytest.mark.parametrize(
    ("wheels", "seed"),
    one_seed(FaultyWheels(slip_radps=0.08), FaultyWheels(dies_s=4.0), FaultyWheels(dies_s=0.0)),
)
def test_a_fault_is_no_lag(wheels: FaultyWheels, seed: int) -> None:
    """Where a wheel slips odometry's speed changes, where an encoder is dead that of the path."""
    learnt = learnt_on(seed, 14.0, EVERYWHERE, wheels, has_corners=True)
    assert abs(learnt.error[2]) < 0.05


def motion_noise_learnt(
    noise: float, with_odometry: bool = False, with_gyro: bool = False, seconds: float = 90.0
) -> npt.NDArray[np.float64]:
    """Mean of what is learnt of changes of twist; those forward have `noise` times the variance of the model.

    (3,) forward, left, rotation. A laser at 25 Hz alone, or with others; the first 60 s are left out.
    """
    config, random, dt = EstimatorConfig(), np.random.default_rng(4), 0.04
    model, x_m, speed_mps, acceleration, learnt = Estimator(config), 0.0, 1.0, 0.0, []
    kept = math.exp(-dt / ACCELERATION_S)
    pushed = config.acceleration * math.sqrt(noise * (1.0 - kept**2) / (2.0 * ACCELERATION_S))
    for k in range(round(seconds / dt)):
        if with_odometry:
            model.add(odometry(1e3 * dt * k, SE2(x_m, 0.0, 0.0)))
        if with_gyro:
            model.add(gyro(1e3 * dt * k, 0.0))
        model.predict(round(1e9 * dt * k))
        scan = SE2(x_m + SIGMA_M * random.standard_normal(), 0.0, 0.0)
        model.correct(matched(scan, np.diag(1.0 / np.array(EVERYWHERE))) if k else None)
        learnt.append(model.filter["motion_noise"].copy())
        x_m, speed_mps = x_m + dt * speed_mps, speed_mps + dt * (acceleration + 0.2 * (1.0 - speed_mps))
        acceleration = kept * acceleration + pushed * random.standard_normal()
    mean: npt.NDArray[np.float64] = np.mean(learnt[round(60.0 / dt) :], axis=0)
    return mean


@pytest.mark.parametrize("noise", [0.1, in_soak(0.3)])
def test_how_much_a_speed_changes_is_learnt_where_only_scans_measure_it(noise: float) -> None:
    assert 0.6 * noise < motion_noise_learnt(noise, seconds=240.0)[0] < 1.4 * noise


def test_a_steady_drive_is_believed_to_go_on_steadily() -> None:
    forward, left, rotation = motion_noise_learnt(0.0).tolist()
    assert max(forward, left) < 0.03
    assert 0.1 <= rotation < 0.15  # a turn begins more suddenly


def test_where_odometry_measures_it_the_model_of_motion_stays_wide() -> None:
    np.testing.assert_array_equal(motion_noise_learnt(0.0, with_odometry=True), 1.0)


def test_a_gyro_measures_the_rotation_alone() -> None:
    forward, left, rotation = motion_noise_learnt(0.0, with_gyro=True).tolist()
    assert max(forward, left) < 0.03
    assert rotation == 1.0
