"""Whether a loop is within the drift of the path between its ends."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from service.geometry.se2 import SE2
from service.mapper.graph.loops.loop_back_end import Batch, LoopBackEnd
from service.mapper.graph.model.keyframe_list import LoopsConfig
from service.mapper.graph.model.loops import Loop
from service.mapper.graph.model.path_drift import (
    MAX_DRIFT_CHI2,
    NEAR_SIGMA_M,
    UNMODELLED_SHARE,
    PathDrift,
    drift_from,
)
from service.mapper.loop_evidence import TOO_FAR
from tests.service.mapper.graph.key_frames import key_frame
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
) -> PathDrift:
    """Ten metres ahead, with equal steps; key frames `beside` are another segment."""
    back_end = LoopBackEnd(LoopsConfig(), None)
    frames = [
        key_frame(
            k * 10**8,
            SE2(STEP_M * k),
            segment=int(k in beside),
            is_lost=k == lost,
            covariance=np.diag([1e-4, 1e-4, 1e-6]),
            motion_covariance=variance * k if is_known else None,
        )
        for k in range(STEPS + 1)
    ]
    back_end.work(Batch(frames))
    return PathDrift(back_end.keyframes, STEP_M)


def loop(x_m: float, y_m: float, theta_rad: float, of: int = 0) -> Loop:
    return Loop(of, STEPS, np.array([x_m, y_m, theta_rad]), SURE, 0.5)


FARTHEST_M = 1.1 * np.sqrt(MAX_DRIFT_CHI2 * (STEPS * VARIANCE[0, 0] + (UNMODELLED_SHARE * 10.0) ** 2))
AT_21_M, AT_19_M = (STEP_M * (STEPS - k) for k in (21, 19))  # from there to the end


@pytest.mark.parametrize(
    ("path", "end", "is_allowed"),
    [
        ({}, loop(10.0 + 0.8 * FARTHEST_M, 0.0, 0.0), True),
        ({}, loop(10.0 + FARTHEST_M, 0.0, 0.0), False),
        ({"is_known": False}, loop(10.0 + FARTHEST_M, 0.0, 0.0), True),  # a step is unknown
        # Rows of shelves look alike; at their ends a scan may see nothing, or a segment begin and end.
        ({"lost": 20}, loop(10.0, 4.0 * BESIDE_M, 0.0), False),
        ({"beside": (20, 21, 22)}, loop(10.0, 4.0 * BESIDE_M, 0.0), False),
        ({"beside": (20, 21, 22)}, loop(AT_21_M, 4.0 * BESIDE_M, 0.0, of=21), True),  # from that segment
        ({"beside": (20, 21, 22)}, loop(AT_19_M, 4.0 * BESIDE_M, 0.0, of=19), False),
        # A scan that was matched wrong leaves the covariance as small as it was: 2 % of the path.
        ({"variance": 1e-4 * VARIANCE}, loop(10.2, 0.0, 0.0), True),
        ({"variance": 1e-4 * VARIANCE}, loop(10.4, 0.0, 0.0), False),
        ({}, loop(10.0, 0.0, 0.6), False),
    ],
)
def test_a_loop_is_allowed_within_the_drift_of_the_path(path: dict[str, Any], end: Loop, is_allowed: bool):
    assert straight(**path).allows(end) is is_allowed


def test_a_loop_is_confirmed_by_a_precise_path_that_agrees():
    sigma_m = np.hypot(np.sqrt(STEPS * VARIANCE[0, 0]), UNMODELLED_SHARE * 10.0)
    there, aside = loop(10.0 + 3.0 * sigma_m, 0.0, 0.0), loop(10.0 + 4.0 * sigma_m, 0.0, 0.0)
    assert straight().confirms(there)
    assert not straight().confirms(aside)
    assert straight().allows(aside)
    assert not straight(is_known=False).confirms(there)
    doubtful = (1.1 * NEAR_SIGMA_M / sigma_m) ** 2 * VARIANCE
    assert not straight(variance=doubtful).confirms(there)  # something alike may lie nearer


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


def test_an_uncertain_step_widens_the_search_beyond_it() -> None:
    """A heading known to 0.1 rad in the middle: 5 m on, the position is known to 0.5 m."""
    back_end = LoopBackEnd(LoopsConfig(), None)
    sure, doubtful = np.diag([1e-4, 1e-4, 1e-6]), np.diag([1e-4, 1e-4, 1e-2])
    back_end.work(
        Batch(
            [
                key_frame(k * 10**8, SE2(STEP_M * k), covariance=doubtful if k == STEPS // 2 else sure)
                for k in range(STEPS + 1)
            ]
        )
    )
    shortcut = loop(0.0, 0.0, 0.0)
    for loops, sigma_m, sigma_rad in (([], 0.5, 0.1), ([shortcut], 0.01, 0.002)):
        off_m, off_rad = drift_from(back_end.keyframes, loops, STEPS, STEP_M, (0.01, 0.0015))
        assert off_m[0] == pytest.approx(sigma_m, rel=0.1)
        assert off_rad[0] == pytest.approx(sigma_rad, abs=0.002)
    assert off_m[STEPS] == off_rad[STEPS] == 0.0
