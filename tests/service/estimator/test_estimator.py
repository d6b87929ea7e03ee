import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from drivers.frames import ImuSample, OdometrySample
from service.estimator import samples
from service.estimator.estimator import (
    ACCELERATION_S,
    FADE_S,
    FIRST_TWIST_SIGMA,
    MIN_SIGMA,
    Estimator,
    EstimatorConfig,
)
from service.estimator.motion import Measurement, Prediction
from service.estimator.samples import CAPACITY
from service.geometry.se2 import SE2
from service.kernels.filter_state import ACCELERATION, ANCHOR, LOCAL, STATES, TWIST
from service.mapper.known_pose import carried
from tests.service.estimator.samples import MS, gyro, matched, odometry

TIGHT = np.diag([1e-6, 1e-6, 1e-8])  # 1 mm, 0.1 mrad
RESOLUTION_M = 2e-4  # of odometry, in the estimator


def driven(
    model: Estimator,
    until_ms: int,
    speed_mps: float = 1.0,
    wheel_scale: float = 1.0,
    offset_ns: int = 0,
    rate_radps: float | None = None,
    from_ms: int = 0,
) -> Prediction:
    """Straight on with odometry each 20 ms and a tight scan each 100 ms; the last prediction."""
    for stamp_ms in range(from_ms, until_ms + 1, 20):
        path_m = speed_mps * stamp_ms * 1e-3
        assert model.add(later(odometry(stamp_ms, SE2(wheel_scale * path_m, 0.0, 0.0)), offset_ns))
        if rate_radps is not None:
            assert model.add(later(gyro(stamp_ms, rate_radps), offset_ns))
        if stamp_ms % 100 == 0:
            predicted = model.predict(stamp_ms * MS + offset_ns)
            model.correct(matched(SE2(path_m, 0.0, 0.0), TIGHT))
    return predicted


@pytest.mark.parametrize("period_ms", [40, 100, 200])
def test_odometry_slower_than_the_scans_measures_each_step_until_a_sample_is_missing(period_ms: int) -> None:
    """1 m/s; scans each 20 ms that measure nothing. Between samples it goes on for 1.5 periods."""
    model, path_m, variance_m2, silent_ms = Estimator(EstimatorConfig()), 0.0, 0.0, []
    for stamp_ms in range(0, 1400, 20):
        if stamp_ms % period_ms == 0 and stamp_ms <= 1000:
            model.add(odometry(stamp_ms, SE2(stamp_ms * 1e-3, 0.0, 0.0)))
        if stamp_ms >= 600:
            increment = model.predict((stamp_ms + 5) * MS).increment
            model.correct(None)
            if increment is not None:
                path_m += increment.pose.x_m
                variance_m2 += increment.variance_m2
                beyond_s = 1e-3 * ((stamp_ms + 5) - min(stamp_ms, 1000) // period_ms * period_ms)
                assert increment.end_m2 == pytest.approx(
                    EstimatorConfig().acceleration ** 2 * beyond_s**3 / 3
                )
            elif stamp_ms > 600:
                silent_ms.append(stamp_ms)
    silent_from_ms = 1000 + 1.5 * period_ms
    assert silent_ms[0] == pytest.approx(silent_from_ms + 20, abs=20)
    assert silent_ms[-1] == 1380
    assert path_m == pytest.approx((silent_ms[0] - 620) * 1e-3, abs=0.025)
    assert variance_m2 == pytest.approx(EstimatorConfig().odometry_position_walk ** 2 * path_m, rel=0.1)


@pytest.mark.parametrize("period_ms", [120, 200])
@pytest.mark.parametrize("sigma_m", [0.1, 0.02])
def test_odometry_slower_than_the_scans_measures_an_acceleration(period_ms: int, sigma_m: float) -> None:
    """At 1 m/s^2 from standstill for 1.6 s; scans each 20 ms measure little along the path."""
    covariance, errors = np.diag([sigma_m**2, 1e-6, 1e-6]), []
    for seed in range(4):
        model, noise = Estimator(EstimatorConfig()), np.random.default_rng(seed)
        for stamp_ms in range(0, 2601, 20):
            true_m = 0.5 * (max(stamp_ms - 1000, 0) * 1e-3) ** 2
            if stamp_ms % period_ms == 0:
                model.add(odometry(stamp_ms, SE2(true_m, 0.0, 0.0)))
            if stamp_ms >= 400:
                model.predict(stamp_ms * MS)
                scan = matched(SE2(true_m + float(noise.normal(0.0, sigma_m)), 0.0, 0.0), covariance)
                motion = model.correct(scan)
                off_m, sigma_m2 = motion.pose_odom_base.x_m - true_m, motion.covariance[0, 0] + 1e-6
                errors.append(abs(off_m) / math.sqrt(sigma_m2))
    assert max(errors) < 3.0


def test_the_motion_since_the_anchor_is_as_certain_after_a_key_frame() -> None:
    model = Estimator(EstimatorConfig())
    for stamp_ms in range(0, 1061, 20):  # the newest sample is 60 ms old, the anchor 40 ms
        if stamp_ms % 200 == 0:
            model.add(odometry(stamp_ms, SE2(stamp_ms * 1e-3, 0.0, 0.0)))
        model.predict(stamp_ms * MS)
        model.correct(matched(SE2(stamp_ms * 1e-3, 0.0, 0.0), TIGHT))

    def motion_covariance() -> np.ndarray:
        rows = np.zeros((3, STATES))
        rows[:, LOCAL : LOCAL + 3], rows[:, ANCHOR : ANCHOR + 3] = np.eye(3), -np.eye(3)
        return rows @ model.filter["covariance"] @ rows.T

    before, pose_covariance = motion_covariance(), model.filter["covariance"][LOCAL, LOCAL]
    model.settle(0.3)
    assert model.filter["covariance"][LOCAL, LOCAL] == pytest.approx(0.09 * pose_covariance)
    np.testing.assert_allclose(motion_covariance(), before, rtol=1e-9, atol=1e-18)
    assert before[0, 0] > 1e-9


def test_what_wrong_odometry_has_moved_is_not_measured_when_it_is_right_again() -> None:
    """At rest, scans each 20 ms measure nothing along x; odometry is wrong by 1 m while it has a fault."""
    model, blind = Estimator(EstimatorConfig()), np.diag([1.0, 1e-6, 1e-6])
    for stamp_ms in range(0, 3001, 20):
        model.filter["noise"] = 1e5 if 1000 <= stamp_ms < 2000 else 1.0
        wheels_m = min(max(stamp_ms - 1000, 0), 960) / 960.0
        model.add(odometry(stamp_ms, SE2(wheels_m, 1e-6 * stamp_ms, 0.0)))
        model.predict(stamp_ms * MS)
        motion = model.correct(matched(SE2(), blind))
    assert abs(motion.pose_odom_base.x_m) < 0.1


@pytest.mark.parametrize("period_ms", [20, 120, 200])
def test_odometry_that_counts_backwards_is_named_also_where_it_is_slow(period_ms: int) -> None:
    """At 1 m/s for 6 s, scans each 20 ms measure the pose."""
    model = Estimator(EstimatorConfig())
    for stamp_ms in range(0, 6001, 20):
        if stamp_ms % period_ms == 0:
            model.add(odometry(stamp_ms, SE2(-stamp_ms * 1e-3, 0.0, 0.0)))
        model.predict(stamp_ms * MS)
        model.correct(matched(SE2(stamp_ms * 1e-3, 0.0, 0.0), TIGHT))
    assert "distance off by" in model.fault


def test_a_gyro_measures_the_rotation_between_samples_of_odometry() -> None:
    """Odometry each 300 ms is extrapolated; 1 s straight on, then the vehicle turns at 0.5 rad/s."""
    model, increments = Estimator(EstimatorConfig()), []
    for stamp_ms in range(0, 1301, 20):
        assert model.add(gyro(stamp_ms, 0.5 if stamp_ms > 920 else 0.0))
        if stamp_ms % 300 == 0:
            assert model.add(odometry(stamp_ms, SE2(stamp_ms * 1e-3, 0.0, 0.0)))
        if stamp_ms >= 600:
            increments.append(model.predict(stamp_ms * MS).increment)
            model.correct(None)
    turning = [one for one in increments[-18:] if one is not None]
    assert len(turning) > 10
    for increment in turning:
        assert increment.pose.theta_rad == pytest.approx(0.5 * 0.02, abs=5e-4)
        assert 0.0 < increment.variance_rad2 < 1e-4
        assert increment.end_rad2 == 0.0


@pytest.mark.parametrize("speed_mps", [1.0, -0.5])
def test_odom_is_the_base_when_the_first_sweep_began(speed_mps: float) -> None:
    """And not in its middle, of which the first prediction is; the map is laid from there."""
    model = Estimator(EstimatorConfig())
    for stamp_ms in range(-100, 21, 20):
        model.add(odometry(stamp_ms, SE2(speed_mps * stamp_ms * 1e-3, 0.0, 0.0)))
    model.begin_at(0)
    first = model.predict(15 * MS)
    assert first.pose_odom_base.x_m == pytest.approx(15e-3 * speed_mps, abs=1e-5)
    assert model.moved(-0.015).pose_odom_base == SE2()
    assert first.local_covariance.max() < 1e-7
    for stamp_ms in range(30, 101, 20):
        model.add(odometry(stamp_ms, SE2(speed_mps * stamp_ms * 1e-3, 0.0, 0.0)))
    assert model.predict(55 * MS).pose_odom_base.x_m == pytest.approx(55e-3 * speed_mps, abs=1e-3)


def over_a_step(root_density: float, tau_s: float, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Transition of displacement, speed and acceleration, (3, 3), and its noise, by one matrix exponential.

    Source: Van Loan, Computing integrals involving the matrix exponential, IEEE TAC 23, 1978.
    """
    rates = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0 / tau_s]])
    both = np.zeros((6, 6))
    both[:3, :3], both[3:, 3:] = -rates, rates.T
    both[2, 5] = (root_density / tau_s) ** 2
    both_steps = expm(dt * both)
    transition = both_steps[3:, 3:].T
    return transition, transition @ both_steps[:3, 3:]


def later(sample, offset_ns: int):
    return replace(sample, stamp_ns=sample.stamp_ns + offset_ns, arrived_ns=sample.arrived_ns + offset_ns)


def test_a_straight_path_is_the_least_squares_solution_over_all_of_it() -> None:
    """Along x everything is linear: positions and speeds of all scans at once, solved by QR, agree."""
    config = EstimatorConfig(
        odometry_scale_sigma=0.0, odometry_lag_sigma_s=0.0, odometry_jitter_s=0.0, odometry_position_walk=1e-9
    )
    noise, count, dt = np.random.default_rng(3), 24, 0.04  # ends before the noise of odometry is judged
    true_m = np.cumsum(
        np.r_[0.0, np.full(count - 1, 0.006)] + np.r_[0.0, 2e-4 * noise.standard_normal(count - 1)]
    )
    wheels_m = np.r_[0.0, np.diff(true_m) + 3e-4 * noise.standard_normal(count - 1)].cumsum()
    scans_m = true_m + 2e-3 * noise.standard_normal(count)
    sigma_m = np.where(np.arange(count) % 3 == 0, np.inf, 2e-3)  # each third scan is blind along x

    model = Estimator(config)
    for k in range(count):
        model.add(odometry(40 * k, SE2(wheels_m[k], 0.0, 0.0)))
        model.predict(40 * k * MS)
        covariance = np.diag([min(sigma_m[k], 1.0) ** 2, 1e-6, 1e-6])
        information = np.diag([1.0 / sigma_m[k] ** 2, 1e6, 1e6])
        scan = Measurement(SE2(scans_m[k], 0.0, 0.0), covariance, information, is_joined=False)
        motion = model.correct(scan if k else None)

    rows, right = [], []

    def measure(columns: dict[int, float], value: float, sigma: float) -> None:
        row = np.zeros(3 * count)  # x_0, v_0, a_0, x_1, ...
        row[list(columns)] = list(columns.values())
        rows.append(row / sigma)
        right.append(value / sigma)

    measure({0: 1.0}, 0.0, MIN_SIGMA[0])
    measure({1: 1.0}, 0.0, FIRST_TWIST_SIGMA[0])
    measure({2: 1.0}, 0.0, config.acceleration / math.sqrt(2.0 * ACCELERATION_S))
    transition, noise_of_step = over_a_step(config.acceleration, ACCELERATION_S, dt)
    root = np.linalg.inv(np.linalg.cholesky(noise_of_step))
    for k in range(1, count):
        x0, x1 = 3 * k - 3, 3 * k
        for row in root:
            before, after = -row @ transition, row
            measure({x0 + i: before[i] for i in range(3)} | {x1 + i: after[i] for i in range(3)}, 0.0, 1.0)
        odometry_m = wheels_m[k] - wheels_m[k - 1]
        measure({x0: -1.0, x1: 1.0}, odometry_m, RESOLUTION_M)
        if math.isfinite(sigma_m[k]):
            measure({x1: 1.0}, scans_m[k], sigma_m[k])
    system = np.array(rows)
    solution = np.linalg.lstsq(system, np.array(right), rcond=None)[0]
    spread = np.linalg.inv(system.T @ system)[-3:, -3:]

    assert motion.pose_odom_base.x_m == pytest.approx(solution[-3], abs=1e-9)
    assert motion.twist_base[0] == pytest.approx(solution[-2], abs=1e-9)
    assert model.filter["acceleration"][0] == pytest.approx(solution[-1], abs=1e-9)
    rows = (LOCAL, TWIST, ACCELERATION)
    believed = model.filter["covariance"][np.ix_(rows, rows)]
    np.testing.assert_allclose(believed, spread, rtol=1e-9, atol=1e-9 * spread[0, 0])
    assert abs(motion.pose_odom_base.x_m - scans_m[-1]) > 1e-5  # it is not the last scan


def test_a_scan_alone_and_the_same_scan_joined_by_hand_are_one() -> None:
    alone, joined = Estimator(EstimatorConfig()), Estimator(EstimatorConfig())
    for model in (alone, joined):
        driven(model, 1000)
        prior = model.predict(1100 * MS)
    information = np.array([[4e4, 1e4, 0.0], [1e4, 9e4, 2e4], [0.0, 2e4, 1e6]])
    off = np.array([0.01, -0.004, 0.002])
    scan = Measurement(
        prior.pose_odom_base @ SE2.exp(*off), np.linalg.inv(information), information, is_joined=False
    )
    covariance = np.linalg.inv(np.linalg.inv(prior.local_covariance) + information)
    step = SE2.exp(*(covariance @ information @ off))
    mean = prior.pose_odom_base @ step
    covariance = carried(covariance, np.array(step))
    first = alone.correct(scan)
    second = joined.correct(Measurement(mean, covariance, information))
    for got in (first, second):
        away = mean.inverse() @ got.pose_odom_base
        assert (away.x_m, away.y_m, away.theta_rad) == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)
    assert first.twist_base == pytest.approx(second.twist_base, abs=1e-12)
    local = alone.filter["covariance"][LOCAL : LOCAL + 3, LOCAL : LOCAL + 3]
    np.testing.assert_allclose(local, covariance, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("is_scan_alone", [False, True])
def test_the_motion_of_a_segment_is_an_error_of_the_pose_but_none_against_the_segment(
    is_scan_alone: bool,
) -> None:
    models = Estimator(EstimatorConfig()), Estimator(EstimatorConfig())
    noise, motions = np.diag([4.0, 1.0, 0.1]), []
    for model, of_segment in zip(models, (None, noise), strict=True):
        if not is_scan_alone:
            driven(model, 1000)
        for stamp_ms in (1000, 1040, 1080):
            prior = model.predict(stamp_ms * MS)
            measured = Measurement(prior.pose_odom_base, TIGHT, np.linalg.inv(TIGHT))
            motions.append(model.correct(measured._replace(segment_noise=of_segment)))
    added = motions[-1].covariance - motions[2].covariance
    np.testing.assert_allclose(added, 3.0 * noise, rtol=1e-3, atol=0.02)
    block = slice(LOCAL, LOCAL + 3)
    np.testing.assert_array_equal(*(model.filter["covariance"][block, block] for model in models))


def test_the_first_speed_is_not_that_of_two_samples_of_a_burst() -> None:
    model = Estimator(EstimatorConfig())
    for stamp_ms in (0, 20, 40, 60, 80, 100, 100.1, 100.2):
        model.add(odometry(stamp_ms, SE2(stamp_ms * 1e-3 + 1e-3 * (stamp_ms == 100.2), 0.0, 0.0)))
    assert model.predict(101 * MS).twist_base[0] == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("bias_radps", [0.02, -0.01])
def test_the_bias_of_the_gyro_is_learnt(bias_radps: float) -> None:
    model = Estimator(EstimatorConfig())
    driven(model, 20_000, rate_radps=bias_radps)
    assert model.filter["bias_radps"] == pytest.approx(bias_radps, abs=5e-4)


def test_a_bias_that_jumps_is_learnt_again_within_two_seconds() -> None:
    model = Estimator(EstimatorConfig())
    driven(model, 20_000, rate_radps=0.0)
    driven(model, 22_000, rate_radps=0.1, from_ms=20_020)
    assert model.filter["bias_radps"] == pytest.approx(0.1, abs=5e-3)


def test_odometry_carries_over_a_minute_and_a_half_without_scans() -> None:
    model = Estimator(EstimatorConfig())
    for stamp_ms in range(0, 87_001, 20):
        path_m = max(stamp_ms - 2000, 0) / 85_000.0
        model.add(odometry(stamp_ms, SE2(path_m, 0.0, 0.0)))
        if stamp_ms % 100 == 0 and stamp_ms <= 2000:
            model.predict(stamp_ms * MS)
            model.correct(matched(SE2(), TIGHT))
    predicted = model.predict(87_000 * MS)
    assert predicted.elapsed_s == pytest.approx(85.0)
    assert predicted.is_measured
    assert predicted.pose_odom_base.x_m == pytest.approx(1.0, abs=0.05)
    assert predicted.pose_odom_base.y_m == pytest.approx(0.0, abs=0.05)
    sigma_m = math.sqrt(predicted.local_covariance[0, 0])
    assert 0.01 < sigma_m < 0.2


@pytest.mark.parametrize(("before_ms", "after_ms"), [(0, 0), (400, 0), (0, 50)])
def test_a_burst_of_odometry_does_not_disturb(before_ms: int, after_ms: int) -> None:
    """20 samples stamped within 2 ms, off by encoder ticks; odometry is silent so long before and after."""
    off_m, speed_mps = [], []
    model = Estimator(EstimatorConfig())
    for stamp_ms in range(0, 4001, 20):
        if not (3000 - before_ms < stamp_ms < 3000 or 3000 < stamp_ms < 3000 + after_ms):
            model.add(odometry(stamp_ms, SE2(stamp_ms * 1e-3, 0.0, 0.0)))
        if stamp_ms == 3000:
            for k in range(1, 21):
                tick_m = 1e-3 * (k % 2)
                model.add(odometry(stamp_ms + 0.1 * k, SE2(stamp_ms * 1e-3 + 1e-4 * k + tick_m, 0.0, 0.0)))
        if stamp_ms % 40 == 0:
            predicted = model.predict(stamp_ms * MS)
            model.correct(matched(SE2(stamp_ms * 1e-3, 0.0, 0.0), TIGHT))
            off_m.append(predicted.pose_odom_base.x_m - stamp_ms * 1e-3)
            speed_mps.append(predicted.twist_base[0])
    assert np.abs(off_m[25:]).max() < 0.003
    assert np.abs(np.array(speed_mps[25:]) - 1.0).max() < 0.1
    assert np.abs(model.filter["scale"]) < 0.005


def test_odometry_that_grows_unsure_widens_the_prediction() -> None:
    def sigmas(growth: float) -> np.ndarray:
        """growth: variance that the device adds each second, m^2 and rad^2."""
        model = Estimator(EstimatorConfig())
        for stamp_ms in range(0, 3001, 20):
            own = growth * stamp_ms * 1e-3
            sample = odometry(stamp_ms, SE2(stamp_ms * 1e-3, 0.0, 0.0))
            model.add(replace(sample, covariance=(own, 0.0, 0.0, 0.0, own, 0.0, 0.0, 0.0, own)))
            if stamp_ms <= 2000 and stamp_ms % 100 == 0:
                model.predict(stamp_ms * MS)
                model.correct(matched(SE2(stamp_ms * 1e-3, 0.0, 0.0), TIGHT))
        return np.sqrt(np.diag(model.predict(3000 * MS).local_covariance))

    sure, unsure = sigmas(0.0), sigmas(0.01)
    assert (unsure > 2.0 * sure).all()
    assert unsure[0] == pytest.approx(0.1, rel=0.3)


@pytest.mark.parametrize("begins_at", [SE2(), SE2(10.0, 0.0, 2.5), SE2(1e8, -1e8, 0.0)])
def test_odometry_that_begins_again_costs_the_step_in_which_it_did(
    begins_at: SE2, caplog: pytest.LogCaptureFixture
) -> None:
    """The computer of the base restarts while the vehicle drives on."""
    model, off_m, measured = Estimator(EstimatorConfig()), [], []
    for stamp_ms in range(0, 15_001, 20):
        path_m = stamp_ms * 1e-3
        is_restarted = stamp_ms >= 10_000
        step = SE2(path_m - 10.0 if is_restarted else path_m, 0.0, 0.0)
        assert model.add(odometry(stamp_ms, begins_at @ step if is_restarted else step))
        if stamp_ms % 100 == 0:
            predicted = model.predict(stamp_ms * MS)
            model.correct(matched(SE2(path_m, 0.0, 0.0), TIGHT))
            off_m.append(abs(predicted.pose_odom_base.x_m - path_m))
            measured.append(predicted.is_measured)
    assert max(off_m[5:]) < 0.02
    assert measured[5:].count(False) <= 1
    assert abs(model.filter["scale"]) < 0.005
    assert not model.fault
    assert [record.message.startswith("base: odometry jumps by") for record in caplog.records] == [True]


def test_a_restart_right_after_a_scan_is_no_motion() -> None:
    """Odometry begins again 10 m away, so soon that it counts as there at the scan: no one is to blame."""
    model = Estimator(EstimatorConfig())
    driven(model, 5000)
    for stamp_ms in range(5020, 7001, 20):
        path_m = stamp_ms * 1e-3
        assert model.add(odometry(stamp_ms, SE2(path_m - 10.0, 0.0, 0.0)))
        if stamp_ms % 100 == 40:
            assert model.predict(stamp_ms * MS).pose_odom_base.x_m == pytest.approx(path_m, abs=0.02)
            model.correct(matched(SE2(path_m, 0.0, 0.0), TIGHT))
            assert not model.fault


def test_only_differences_of_time_count() -> None:
    near, unix = (
        driven(Estimator(EstimatorConfig()), 2000, 0.7, 1.02, offset_ns, rate_radps=0.01)
        for offset_ns in (0, 1_700_000_000_000_000_003)
    )
    assert near.pose_odom_base == unix.pose_odom_base
    assert near.twist_base == unix.twist_base
    np.testing.assert_array_equal(near.covariance, unix.covariance)


def test_samples_out_of_order_or_no_numbers_are_refused() -> None:
    model = Estimator(EstimatorConfig())
    assert model.add(odometry(20, SE2()))
    assert not model.add(odometry(20, SE2(1.0, 0.0, 0.0)))
    assert not model.add(odometry(10, SE2(1.0, 0.0, 0.0)))
    assert model.add(gyro(20, 0.0))
    assert not model.add(gyro(20, 1.0))
    assert not model.add(gyro(10, 1.0))
    assert not model.add(gyro(30, math.nan))
    for x_m in (math.nan, math.inf):
        assert not model.add(odometry(30, SE2(x_m, 0.0, 0.0)))
    broken: OdometrySample | ImuSample = replace(odometry(30, SE2()), covariance=(math.nan,) * 9)
    assert not model.add(broken)
    assert model.add(odometry(30, SE2()))
    assert model.add(gyro(30, 0.0))


def test_a_pause_of_odometry_between_two_scans_is_reported_and_one_of_the_laser_is_none() -> None:
    model = Estimator(EstimatorConfig())
    assert driven(model, 2000).pause_s == 0.0
    for stamp_ms in range(2020, 4001, 20):
        model.add(odometry(stamp_ms, SE2(stamp_ms * 1e-3, 0.0, 0.0)))
    assert model.predict(4000 * MS).pause_s == 0.0  # the laser was silent, odometry was not
    model.correct(None)
    model.add(odometry(9000, SE2(9.0, 0.0, 0.0)))
    assert model.predict(9000 * MS).pause_s == pytest.approx(5.0)
    alone = Estimator(EstimatorConfig())
    assert alone.predict(1000 * MS).pause_s == 0.0
    assert alone.predict(10_000 * MS).pause_s == pytest.approx(
        9.0
    )  # without odometry the motion is not measured


def test_without_odometry_the_last_speed_goes_on_and_grows_vague() -> None:
    model = Estimator(EstimatorConfig())
    for stamp_ms in range(0, 2001, 40):
        model.predict(stamp_ms * MS)
        model.correct(matched(SE2(stamp_ms * 1e-3, 0.0, 0.0), TIGHT))
    soon = model.predict(2100 * MS)
    assert not soon.is_measured
    assert soon.pose_odom_base.x_m == pytest.approx(2.1, abs=0.005)
    model.correct(None)
    late = model.predict(3100 * MS)
    fades = math.exp(-soon.elapsed_s / FADE_S)  # once: one scan confirmed nothing
    assert late.pose_odom_base.x_m == pytest.approx(soon.pose_odom_base.x_m + fades, abs=0.02)
    added = over_a_step(EstimatorConfig().acceleration, ACCELERATION_S, 1.0)[1]
    assert late.local_covariance[0, 0] > soon.local_covariance[0, 0] + added[0, 0]


def test_samples_that_are_dropped_while_they_wait_are_reported_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(samples, "MAX_SAMPLES", CAPACITY)
    # Those before the newest scan are forgotten: none is left to be dropped when as many have come.
    assert driven(Estimator(EstimatorConfig()), 20 * (CAPACITY + 5)).samples_dropped == 0
    model = Estimator(EstimatorConfig())
    for stamp_ms in range(CAPACITY + 1):
        assert model.add(odometry(stamp_ms, SE2()))
        assert model.add(gyro(stamp_ms, 0.0))
    assert model.predict(CAPACITY * MS).samples_dropped == 2 * (CAPACITY // 2)
    assert model.predict((CAPACITY + 10) * MS).samples_dropped == 0
