"""Whether a loop is within the drift of the path between its ends."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from service.geometry.se2 import SE2
from service.mapper.graph.loops.loop_back_end import LoopBackEnd
from service.mapper.graph.loops.loop_batches import Batch
from service.mapper.graph.model.keyframe_list import KeyFrame
from service.mapper.graph.model.loops import Loop
from service.mapper.graph.model.loops_config import LoopsConfig
from service.mapper.graph.model.path_drift import (
    MAX_DRIFT_CHI2,
    NEAR_SIGMA_M,
    UNMODELLED_SHARE,
    PathDrift,
)
from service.mapper.refused_loops import TOO_FAR
from tests.service.mapper.graph.loops.rings import key_frames

STEPS, STEP_M = 40, 0.25
VARIANCE = np.diag([4e-4, 1e-4, 1e-8])  # that a step adds: m^2, m^2, rad^2
SURE = 1e-12 * np.eye(3)
BESIDE_M = 1.5
BATCH = 10


def straight(
    is_known: bool = True,
    lost: int | None = None,
    variance: np.ndarray = VARIANCE,
    beside: Sequence[int] = (),
    doubtful: int | None = None,
) -> PathDrift:
    """Ten metres ahead, with equal steps; key frames `beside` are another segment, and `doubtful` ones have a
    low inlier ratio.
    """
    back_end = LoopBackEnd(LoopsConfig(), None)
    frames = [
        KeyFrame(
            k * 10**8,
            SE2(STEP_M * k, 0.0, 0.0),
            np.diag([1e-4, 1e-4, 1e-6]),
            int(k in beside),
            0.4 if k == doubtful else 0.9,
            k == lost,
            np.zeros((0, 2), np.float32),
            (0.0, 0.0),
            0.01,
            motion_covariance=variance * k if is_known else None,
        )
        for k in range(STEPS + 1)
    ]
    back_end.work(Batch(frames))
    return PathDrift(back_end.keyframes, STEP_M)


def loop(x_m: float, y_m: float, theta_rad: float, of: int = 0) -> Loop:
    return Loop(of, STEPS, np.array([x_m, y_m, theta_rad]), SURE, 0.5)


def test_a_loop_beyond_the_drift_is_not_allowed_unless_a_step_is_unknown():
    off_m = 1.1 * np.sqrt(MAX_DRIFT_CHI2 * (STEPS * VARIANCE[0, 0] + (UNMODELLED_SHARE * 10.0) ** 2))
    assert straight().allows(loop(10.0 + 0.8 * off_m, 0.0, 0.0))
    assert not straight().allows(loop(10.0 + off_m, 0.0, 0.0))
    assert straight(is_known=False).allows(loop(10.0 + off_m, 0.0, 0.0))


@pytest.mark.parametrize("odd", [{"lost": 20}, {"beside": (20, 21, 22)}], ids=["unseen", "beside"])
def test_a_similar_row_is_refused_where_the_path_was_poorly_matched(odd: dict[str, Any]):
    """At the end of a row of vines a scan may see nothing, or a segment may begin and end."""
    drift = straight(**odd)
    assert drift.chi2(loop(10.0, BESIDE_M, 0.0)) == pytest.approx(
        straight().chi2(loop(10.0, BESIDE_M, 0.0)), rel=0.05
    )
    assert not drift.allows(loop(10.0, 4.0 * BESIDE_M, 0.0))


def test_the_step_from_a_detached_segment_beside_the_path_is_unknown():
    drift = straight(beside=(20, 21, 22))
    assert drift.allows(loop(0.25 * (STEPS - 21), 4.0 * BESIDE_M, 0.0, of=21))
    assert not drift.allows(loop(0.25 * (STEPS - 19), 4.0 * BESIDE_M, 0.0, of=19))


def test_a_loop_is_confirmed_by_a_precise_path_that_agrees():
    sigma_m = np.hypot(np.sqrt(STEPS * VARIANCE[0, 0]), UNMODELLED_SHARE * 10.0)
    there, aside = loop(10.0 + 3.0 * sigma_m, 0.0, 0.0), loop(10.0 + 4.0 * sigma_m, 0.0, 0.0)
    assert straight().confirms(there)
    assert not straight().confirms(aside)
    assert straight().allows(aside)
    assert not straight(is_known=False).confirms(there)
    doubtful = (1.1 * NEAR_SIGMA_M / sigma_m) ** 2 * VARIANCE
    assert not straight(variance=doubtful).confirms(there)  # something alike may lie nearer


def test_an_unnoticed_slip_does_not_prevent_loops():
    """A scan that was matched wrong leaves the covariance as small as it was."""
    sure = straight(variance=1e-4 * VARIANCE)
    assert sure.allows(loop(10.0 * 1.02, 0.0, 0.0))
    assert not sure.allows(loop(10.0 * 1.04, 0.0, 0.0))


def test_a_slip_at_a_poor_match_does_not_prevent_loops():
    """A turn onto new ground may be matched 0.3 rad off, with the covariance of a good match."""
    turned = loop(10.0, 0.0, 0.6)
    assert not straight().allows(turned)
    assert straight(doubtful=30).allows(turned)


@pytest.mark.parametrize("is_known", [True, False])
def test_a_similar_aisle_beside_it_makes_no_loop(is_known: bool):
    """Without a covariance of the path the same scans close a loop."""
    aisle, _ = key_frames(0.5, turn_error_radpm=0.0)
    away = SE2(0.0, BESIDE_M, 0.0)
    like = [
        replace(frame, stamp_ns=frame.stamp_ns + 10**11, pose_odom_base=away @ frame.pose_odom_base)
        for frame in aisle
    ]
    frames = [
        replace(frame, motion_covariance=0.2 * VARIANCE * k if is_known else None)
        for k, frame in enumerate([*aisle, *like])
    ]
    back_end = LoopBackEnd(LoopsConfig(), None)
    for k in range(0, len(frames), BATCH):
        back_end.work(Batch(frames[k : k + BATCH]))
    result = back_end.work(Batch([], is_last=True))
    assert (result.loops == 0) == is_known
    assert result.saved is not None
    assert result.saved.refused is not None
    assert (TOO_FAR in result.saved.refused.reason) == is_known
