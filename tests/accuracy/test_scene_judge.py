"""A verdict counts scans that say `ok` and are wrong, and those that say otherwise and are right."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from service.geometry.se2 import SE2
from service.outputs import MapperOutput, State
from tests.accuracy.scene_judge import judge

STEP_NS = 100_000_000
FROM_NS, TO_NS = 40 * STEP_NS, 70 * STEP_NS
SCANS = 100
TRUTH = [SE2(0.1 * k, 0.0, 0.0) for k in range(SCANS)]  # 1 m/s
SIGMA_M = 0.01


def outputs(
    ahead_m: Callable[[int], float] = lambda k: 0.0,
    state: Callable[[int], State] = lambda k: "ok",
    of_map: SE2 | None = None,
    sigma_m: float = SIGMA_M,
) -> list[MapperOutput]:
    return [
        MapperOutput(
            stamp_ns=k * STEP_NS,
            pose_odom_base=(of_map or SE2()) @ TRUTH[k] @ SE2(ahead_m(k), 0.0, 0.0),
            pose_map_odom=SE2(),
            twist_base=(1.0, 0.0, 0.0),
            covariance=np.diag([sigma_m**2, sigma_m**2, 1e-6]),
            state=state(k),
            reason="",
            inlier_ratio=1.0,
        )
        for k in range(SCANS)
    ]


def test_right_and_ok_all_the_time_is_nothing_wrong() -> None:
    verdict = judge(outputs(), TRUTH, FROM_NS, TO_NS)
    assert (verdict.ok_off, verdict.ok_beyond, verdict.needless_percent, verdict.lost_percent) == (0, 0, 0, 0)
    assert (verdict.end_m, verdict.right_after_s) == pytest.approx((0.0, 0.0), abs=1e-9)


def test_an_error_of_the_map_before_the_scene_is_no_error_of_the_scene() -> None:
    verdict = judge(outputs(of_map=SE2(0.5, -0.3, 0.2)), TRUTH, FROM_NS, TO_NS)
    assert verdict.worst_m == pytest.approx(0.0, abs=1e-9)
    assert verdict.ok_off == 0


def test_scans_that_are_off_and_ok_are_counted() -> None:
    verdict = judge(outputs(lambda k: 0.5 if 50 <= k < 60 else 0.0), TRUTH, FROM_NS, TO_NS)
    assert (verdict.ok_off, verdict.ok_beyond) == (10, 10)
    assert (verdict.worst_m, verdict.fault_m) == pytest.approx((0.5, 0.0))
    degraded = outputs(lambda k: 0.5 if 50 <= k < 60 else 0.0, lambda k: "degraded" if 50 <= k < 60 else "ok")
    assert judge(degraded, TRUTH, FROM_NS, TO_NS).ok_off == 0


def test_beyond_is_beyond_the_covariance_and_five_centimetres() -> None:
    def beyond(off_m: float, sigma_m: float) -> int:
        return judge(
            outputs(lambda k: off_m if k >= 90 else 0.0, sigma_m=sigma_m), TRUTH, FROM_NS, TO_NS
        ).ok_beyond

    assert beyond(0.06, 0.01) == 10
    assert beyond(0.04, 0.005) == 0
    assert beyond(0.06, 0.05) == 0


def test_needless_is_not_ok_and_right_and_shown_apart_outside_of_the_scene() -> None:
    during = judge(outputs(state=lambda k: "degraded" if 40 <= k < 50 else "ok"), TRUTH, FROM_NS, TO_NS)
    assert (during.needless_percent, during.needless_still_percent) == pytest.approx((10.0, 0.0))
    after = judge(outputs(state=lambda k: "lost" if k >= 95 else "ok"), TRUTH, FROM_NS, TO_NS)
    assert (after.needless_percent, after.needless_still_percent, after.lost_percent) == pytest.approx(
        (5, 5, 5)
    )
    wrong = judge(outputs(lambda k: 0.5 if k >= 95 else 0.0, lambda k: "lost"), TRUTH, FROM_NS, TO_NS)
    assert wrong.needless_percent == pytest.approx(95.0)


def test_errors_are_of_the_way_since_the_scene_began() -> None:
    verdict = judge(outputs(lambda k: 0.06 if k >= 60 else 0.0), TRUTH, FROM_NS, TO_NS)
    assert verdict.fault_percent == pytest.approx(100.0 * 0.06 / 3.1)
    assert verdict.end_percent == pytest.approx(100.0 * 0.06 / 6.0)
    assert verdict.over_m == 0.0
    beyond = judge(outputs(lambda k: 0.2 if k >= 60 else 0.0), TRUTH, FROM_NS, TO_NS)
    assert beyond.over_m == pytest.approx(0.2 - 0.02 * 3.1)


def test_way_counts_while_no_scan_comes() -> None:
    heard = [k for k in range(SCANS) if not 40 <= k < 70]
    made = [outputs(lambda k: 0.3 if k >= 70 else 0.0)[k] for k in heard]
    verdict = judge(made, [TRUTH[k] for k in heard], FROM_NS, TO_NS)
    assert verdict.fault_percent == pytest.approx(100.0 * 0.3 / 3.1)


def test_right_after_is_from_when_on_all_scans_are_right() -> None:
    def right_after_s(is_wrong: Callable[[int], bool]) -> float:
        return judge(outputs(lambda k: 0.2 if is_wrong(k) else 0.0), TRUTH, FROM_NS, TO_NS).right_after_s

    assert right_after_s(lambda k: 50 <= k < 65) == 0.0
    assert right_after_s(lambda k: 50 <= k < 75) == pytest.approx(0.5)
    assert right_after_s(lambda k: k == 80) == pytest.approx(1.1)
    assert right_after_s(lambda k: k >= 50) == math.inf
    lost = judge(outputs(state=lambda k: "lost" if k < 75 else "ok"), TRUTH, FROM_NS, TO_NS)
    assert lost.right_after_s == pytest.approx(0.5)


def test_heading_is_reported_beside_the_place() -> None:
    made = outputs()
    turned = replace(made[50], pose_odom_base=made[50].pose_odom_base @ SE2(0.0, 0.0, math.radians(-5.0)))
    verdict = judge([*made[:50], turned, *made[51:]], TRUTH, FROM_NS, TO_NS)
    assert (verdict.worst_m, verdict.worst_deg) == pytest.approx((0.0, 5.0), abs=1e-9)
