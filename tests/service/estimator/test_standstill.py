"""Odometry that repeats a pose: at standstill, and after a failure."""

from typing import Any

import numpy as np
import pytest

from service.estimator.estimator import Estimator, EstimatorConfig
from service.geometry.se2 import SE2
from service.mapper.judgement import is_loose, sigmas_of
from tests.service.estimator.samples import MS, SURE, matched, odometry

VAGUE = np.diag([0.015**2, 1e-6, 1e-8])  # along a corridor, m^2
DEAD_MS = 4000


def path_m_at(stamp_ms: int, stands_ms: tuple[int, int]) -> float:
    """1 m/s, but for a stop with 2 m/s^2 before and after."""
    at_s, (from_s, until_s) = stamp_ms * 1e-3, (stands_ms[0] * 1e-3, stands_ms[1] * 1e-3)
    braked_s = min(max(at_s - from_s, 0.0), 0.5)
    begun_s = min(max(at_s - until_s, 0.0), 0.5)
    stood_s = min(max(at_s - from_s - 0.5, 0.0), until_s - from_s - 0.5)
    return at_s - braked_s**2 - stood_s - (begun_s - begun_s**2)


@pytest.mark.parametrize(
    ("dies_ms", "rounding_m", "most_m"),
    [
        pytest.param(0, 0.0, 0.10, id="never lived"),
        pytest.param(DEAD_MS, 0.0, 0.08, id="driving"),
        pytest.param(6500, 0.0, 0.5, id="standing"),
        pytest.param(None, 0.0, 0.08, id="lives"),
        pytest.param(DEAD_MS, 1e-10, 0.08, id="driving, rounds"),
        pytest.param(6500, 1e-10, 1.0, id="standing, rounds"),
        pytest.param(None, 1e-10, 0.08, id="lives, rounds"),
    ],
)
def test_odometry_that_repeats_its_pose_is_used_only_at_standstill(
    dies_ms: int | None, rounding_m: float, most_m: float
) -> None:
    """It reports standstill to 0.2 mm, where scans measure the motion to 15 mm; true from 6.5 to 8 s."""
    model, random, stands_ms = Estimator(EstimatorConfig()), np.random.default_rng(5), (6000, 8000)
    rounding, off_m, faults, counted_m = np.random.default_rng(6), [], [], 0.0
    for stamp_ms in range(0, 12_001, 20):
        path_m = path_m_at(stamp_ms, stands_ms)
        if dies_ms is None or stamp_ms <= dies_ms:
            counted_m = path_m
        sent_m = counted_m + rounding_m * rounding.uniform(-1.0, 1.0)
        assert model.add(odometry(stamp_ms, SE2(sent_m, 0.0, 0.0)))
        if stamp_ms % 100 == 0:
            model.predict(stamp_ms * MS)
            seen = SE2(path_m + random.normal(0.0, 0.015), 0.0, 0.0)
            found = model.correct(matched(seen, VAGUE)).pose_odom_base
            off_m.append(abs(found.x_m - path_m))
            faults.append(model.fault)
    # One that has never moved is believed until a scan contradicts it, by 5.3 sigma; the one that dies
    # unnoticed is detected by the scans, too.
    assert max(off_m) < most_m
    assert faults[-1].startswith("odometry contradicts the scans (it says the same position again") is (
        dies_ms is not None
    )
    if dies_ms is None:
        assert not any(faults)


ALONG_M = 10.0  # sigma of a scan in a bare corridor, along it


@pytest.mark.parametrize(
    ("start_m", "gap_m", "known"),
    [
        pytest.param(0.0, 0.0, True, id="starts as a vehicle does"),
        pytest.param(2.0, 0.0, False, id="jumps: its driver had hung"),
        pytest.param(0.0, 0.3, False, id="scans had moved: the encoder had hung"),
    ],
)
def test_a_standstill_before_the_first_motion_is_measured_once_odometry_moves(
    start_m: float, gap_m: float, known: bool
) -> None:
    """A vehicle switched on in a corridor: dead odometry would say the same. It drives off after 10 s.

    start_m   jump of odometry as it drives off
    gap_m     that scans move after 5 s, beside a door that is seen for a moment
    """
    model, random = Estimator(EstimatorConfig()), np.random.default_rng(5)
    along = np.diag([ALONG_M**2, 1e-6, 1e-8])
    for stamp_ms in range(0, 12_001, 20):
        driven_s = max(stamp_ms - 10_000, 0) * 1e-3
        path_m = 0.5 * driven_s**2
        assert model.add(odometry(stamp_ms, SE2(path_m + (start_m if driven_s else 0.0), 0.0, 0.0)))
        if stamp_ms % 100:
            continue
        predicted = model.predict(stamp_ms * MS)
        covariance = SURE if gap_m and stamp_ms == 5000 else along
        seen_m = path_m + (gap_m if stamp_ms >= 5000 else 0.0) + random.normal(0.0, covariance[0, 0] ** 0.5)
        found = model.correct(matched(SE2(seen_m, 0.0, 0.0), covariance))
        sigma_m = sigmas_of(found.covariance)[0]
        if 4000 < stamp_ms < 10_000:
            assert not predicted.is_measured
            assert sigma_m > 0.5 or gap_m
            assert predicted.is_standing != bool(gap_m and stamp_ms > 5000)
            assert gap_m or abs(found.pose_odom_base.x_m) < 0.03
    assert predicted.is_measured
    assert not predicted.is_standing
    assert (sigma_m < 0.1) is known
    assert not known or found.pose_odom_base.x_m == pytest.approx(path_m, abs=0.1)


def test_odometry_that_has_never_moved_measures_no_motion_while_the_laser_is_silent() -> None:
    """Its vehicle may be towed meanwhile, and its sweeps are deskewed by the scans."""
    model = Estimator(EstimatorConfig())
    for stamp_ms in range(0, 9_001, 20):
        assert model.add(odometry(stamp_ms, SE2()))
        if stamp_ms <= 2000 or stamp_ms == 9000:
            predicted = model.predict(stamp_ms * MS)
            if stamp_ms < 9000:
                model.correct(matched(SE2(), SURE))
    assert predicted.pause_s == pytest.approx(7.0)
    assert is_loose(sigmas_of(predicted.local_covariance))


def test_a_position_that_repeats_while_the_heading_changes_is_no_standstill() -> None:
    """The encoder dies, the heading comes from a gyro; scans measure the motion to 15 mm."""
    model, random = Estimator(EstimatorConfig()), np.random.default_rng(5)
    for stamp_ms in range(0, 6001, 20):
        path_m = stamp_ms * 1e-3
        reported = SE2(min(path_m, DEAD_MS * 1e-3), 0.0, random.normal(0.0, 1e-4))
        assert model.add(odometry(stamp_ms, reported))
        if stamp_ms % 100 == 0:
            model.predict(stamp_ms * MS)
            seen = SE2(path_m + random.normal(0.0, 0.015), 0.0, 0.0)
            found = model.correct(matched(seen, VAGUE)).pose_odom_base
            assert found.x_m == pytest.approx(path_m, abs=0.08)
    assert model.fault.startswith("odometry contradicts the scans (it says the same position again")


def test_a_vehicle_that_stops_and_turns_on_the_spot_is_measured() -> None:
    model, stands_ms = Estimator(EstimatorConfig()), (2000, 4000)
    for stamp_ms in range(0, 4401, 20):
        turned_rad = max(stamp_ms - 2500, 0) * 1e-3
        pose = SE2(path_m_at(min(stamp_ms, 3900), stands_ms), 0.0, turned_rad)
        assert model.add(odometry(stamp_ms, pose))
        if stamp_ms % 100 == 0 and stamp_ms <= 4000:
            model.predict(stamp_ms * MS)
            model.correct(matched(pose, VAGUE))
            assert not model.fault
    predicted = model.predict(4400 * MS)
    assert predicted.is_measured
    assert predicted.pose_odom_base.theta_rad == pytest.approx(1.9, abs=0.01)


def found_after_hanging(counts: bool) -> list[SE2]:
    """Odometry hangs for 4 s, in which its vehicle drives 4 m, and goes on with them or without."""
    model, found = Estimator(EstimatorConfig()), []
    for stamp_ms in range(0, 12_001, 20):
        path_m = stamp_ms * 1e-3
        sent_m = path_m if stamp_ms < 4000 else 4.0 if stamp_ms <= 8000 else path_m - (0.0 if counts else 4.0)
        assert model.add(odometry(stamp_ms, SE2(sent_m, 0.0, 0.0)))
        if stamp_ms % 100 == 0:
            predicted = model.predict(stamp_ms * MS)
            model.correct(matched(SE2(path_m, 0.0, 0.0), SURE))
            assert predicted.pose_odom_base.x_m == pytest.approx(path_m, abs=0.05)
            if 5200 <= stamp_ms < 8000:
                assert model.fault
                assert not predicted.is_measured
            if stamp_ms < 4000 or stamp_ms > 8000:
                assert not model.fault
            found.append(predicted.pose_odom_base)
    assert predicted.is_measured
    return found


def test_odometry_that_moves_again_counts_again_and_what_it_counted_meanwhile_does_not() -> None:
    with_counts, without = (np.array(found_after_hanging(counts)[81:]) for counts in (True, False))
    np.testing.assert_allclose(with_counts, without, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize(("braked_s", "gone_m"), [(0.5, 0.25), (0.02, 3.0), (0.003, 3.0)])
def test_an_impossible_stop_without_scans_measures_no_motion(braked_s: float, gone_m: float) -> None:
    """1 m/s until 4 s, then they brake, a vehicle does within 0.5 s; no scan until 7 s, when they roll on."""
    model = Estimator(EstimatorConfig())
    for stamp_ms in range(0, 9_001, 20):
        at_s = stamp_ms * 1e-3
        since_s = min(max(at_s - 4.0, 0.0), braked_s)
        counted_m = min(at_s, 4.0) + since_s - 0.5 * since_s**2 / braked_s + max(at_s - 7.0, 0.0)
        path_m = counted_m if braked_s == 0.5 else at_s
        assert model.add(odometry(stamp_ms, SE2(counted_m, 0.0, 0.0)))
        if stamp_ms % 100 == 0 and not 4000 < stamp_ms < 7000:
            predicted = model.predict(stamp_ms * MS)
            if stamp_ms == 7000:
                is_known = braked_s == 0.5
                assert predicted.pose_odom_base.x_m == pytest.approx(
                    4.0 + gone_m, abs=0.1 if is_known else 1.0
                )
                assert predicted.pause_s == pytest.approx(0.0 if is_known else 3.0, abs=0.05)
                assert is_loose(sigmas_of(predicted.local_covariance)) != is_known
                assert predicted.is_unconfirmed_stop != is_known
            elif stamp_ms > 7100:
                assert predicted.is_measured
                assert predicted.pose_odom_base.x_m == pytest.approx(path_m, abs=0.02)
            model.correct(matched(SE2(path_m, 0.0, 0.0), SURE))
            assert not model.fault


def stalled(
    speed_mps: float = 1.0,
    counts_on: bool = True,
    is_seen: bool = False,
    scan_ms: int = 100,
    jump_m: float = 0.0,
) -> tuple[float, float, float]:
    """Odometry at 5 Hz repeats its pose from 4 to 6 s. In a corridor scans follow the prediction.

    counts_on   the encoder; else it begins again where it ended
    is_seen     the scans measure the motion
    jump_m      of odometry at the end, besides

    Returns (m moved at the end of the standstill, m off the truth 0.4 s later, sigma there).
    """
    model, at_mps = Estimator(EstimatorConfig()), 1e-3 * speed_mps
    covariance = np.diag([0.01**2 if is_seen else 100.0, 1e-6, 1e-8])
    for stamp_ms in range(0, 6401, 20):
        if stamp_ms % 200 == 0:
            counted_ms = stamp_ms if counts_on or stamp_ms < 6000 else stamp_ms - 1800
            sent_m = at_mps * (4000 if 4000 <= stamp_ms < 6000 else counted_ms) + jump_m * (stamp_ms >= 6000)
            before_m = float(model.filter["pose"][0])
            assert model.add(odometry(stamp_ms, SE2(sent_m, 0.0, 0.0)))
            if stamp_ms == 6000:
                moved_m = float(model.filter["pose"][0]) - before_m
        if stamp_ms % scan_ms == 0:
            predicted = model.predict((stamp_ms + 10) * MS)
            seen = SE2(at_mps * (stamp_ms + 10)) if is_seen else predicted.pose_odom_base
            found = model.correct(matched(seen, covariance))
            off_m = found.pose_odom_base.x_m - at_mps * (stamp_ms + 10)
    return moved_m, abs(off_m), float(np.sqrt(found.covariance[0, 0]))


def test_what_a_driver_reports_late_is_driven_and_may_be_off_by_as_much(
    caplog: pytest.LogCaptureFixture,
) -> None:
    moved_m, off_m, sigma_m = stalled()
    assert "base: odometry repeated its pose and now jumps by 2.0 m and 0 deg" in caplog.text
    assert moved_m > 1.5
    assert off_m < 0.3
    assert 1.5 < sigma_m < 3.0


@pytest.mark.parametrize(
    "drive",
    [
        pytest.param({"is_seen": True}, id="the scans measured the motion"),
        pytest.param({"counts_on": False, "speed_mps": 2.0}, id="a dead encoder"),
        pytest.param({"scan_ms": 1000}, id="scans too far apart to tell"),
        pytest.param({"jump_m": 5.0}, id="farther than the vehicle can have driven"),
        pytest.param({"speed_mps": 0.0, "jump_m": 1.0}, id="it stood"),
    ],
)
def test_other_jumps_of_odometry_after_a_standstill_move_nothing_at_once(drive: dict[str, Any]) -> None:
    assert stalled(**drive)[0] == 0.0
