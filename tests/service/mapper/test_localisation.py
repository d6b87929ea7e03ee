import math
from dataclasses import replace

import numpy as np
import pytest

from drivers.frames import NO_INTENSITY, LaserScan
from service.estimator.motion import Measurement, Motion, OdometryIncrement, Prediction
from service.geometry.se2 import SE2
from service.mapper.components import (
    GraphUpdate,
    MapChange,
    Match,
    Placed,
    PlaceUpdate,
    Points,
    PossiblePlace,
    UnconfirmedPlace,
)
from service.mapper.judgement import MAX_SIGMA_M, MAX_UNMEASURED_S, UNKNOWN_PLACE, UNKNOWN_SIGMA_M
from service.mapper.localisation import NOT_PLACED, UNCONFIRMED_PLACE, UNPROVEN, Localisation, SegmentMotion
from service.outputs import NO_REASON, State

SCAN = LaserScan("front", 1, 1, 0, 1, 0.0, 0.1, 0.1, 20.0, np.zeros(0, np.float32), NO_INTENSITY)
POINTS = Points(np.zeros((9, 2)), np.zeros((9, 2)), np.zeros(9), np.zeros(9, np.int32), SE2(), SCAN)
PRIOR = np.diag([0.01, 0.01, 0.001])
MOTION = Motion(SE2(1.0, 0.0, 0.0), (0.0, 0.0, 0.0), np.diag([0.04, 0.04, 0.01]))
MEASURED = Measurement(MOTION.pose_odom_base, MOTION.covariance, np.eye(3), 1.0)
OF_GRAPH, OF_FIND = SE2(0.1, 0.2, 0.0), SE2(5.0, 0.0, 0.5)
STEP_NS, STEP_S, SPEED_MPS = 40_000_000, 0.04, 1.0
NO = np.eye(3)
ODOMETRY = OdometryIncrement(SE2(SPEED_MPS * STEP_S), 1e-6, 1e-6)
FOUND = PlaceUpdate(unconfirmed_place=UnconfirmedPlace(2, OF_FIND))


def judged(
    news: PlaceUpdate,
    state: State,
    reason: str = "",
    segment: int = 2,
    measured: Measurement | None = MEASURED,
) -> tuple[Localisation, State, str]:
    place = Localisation("proven")
    place.take(GraphUpdate({}, place=news))
    match = place.judged(
        Match(MOTION, POINTS, 0.9, state, reason, measured=measured),
        NO_REASON,
        MapChange(segment=segment),
        OF_GRAPH,
        1,
        PRIOR,
    )
    return place, match.state, match.reason


def test_a_scan_on_an_unconfirmed_segment_has_its_pose_and_an_unknown_place():
    place, *facts = judged(FOUND, "lost", "contradicted")
    assert facts == ["degraded", UNCONFIRMED_PLACE]
    assert place.pose_map_odom == OF_FIND
    np.testing.assert_allclose(place.covariance_of(MOTION), MOTION.covariance + UNKNOWN_PLACE)


@pytest.mark.parametrize(
    ("state", "segment", "measured"), [("lost", 1, MEASURED), ("lost", 2, None), ("ok", 2, MEASURED)]
)
def test_an_unconfirmed_place_affects_no_other_segment_no_unmatched_scan_and_none_on_the_map(
    state: State, segment: int, measured: Measurement | None
):
    place, *facts = judged(FOUND, state, "", segment, measured)
    assert facts == [state, ""]
    assert place.pose_map_odom == OF_GRAPH
    is_on_map = state != "lost" or measured is None
    unknown = 0.0 if is_on_map else UNKNOWN_PLACE
    np.testing.assert_array_equal(place.covariance_of(MOTION), MOTION.covariance + unknown)


@pytest.mark.parametrize(
    ("placed", "facts"),
    [("unknown", ["lost", NOT_PLACED]), ("unproven", ["degraded", UNPROVEN]), ("proven", ["ok", ""])],
)
def test_in_a_stored_map_only_a_confirmed_place_is_ok(placed: Placed, facts: list[str]):
    assert list(judged(PlaceUpdate(placed), "ok")[1:]) == facts


def test_a_lost_pose_is_reported_with_candidate_places_and_a_refused_pose():
    between = "about equally well at (1.0, 2.0) m (310 nats) and (-3.0, 4.0) m (305 nats)"
    between = f"the scans match the map {between}"
    alike = [PossiblePlace(1.0, 2.0, 310.0), PossiblePlace(-3.04, 4.0, 304.7)]
    assert judged(PlaceUpdate(possible=alike), "lost", "why")[2] == f"why; {between}"
    assert judged(PlaceUpdate("unknown", alike), "ok")[2] == f"{between}; drive on, or set the pose"
    assert judged(PlaceUpdate(possible=alike), "ok")[2] == ""
    refused = "the pose set at (7.0, 8.0) m is rejected: no scan matches the map there"
    assert judged(PlaceUpdate(pose_refused=(7.0, 8.0, 0.5)), "lost", "why")[2] == f"{refused}; why"


def test_the_place_by_the_graph_stays_until_its_next_result_or_its_end():
    place, *_ = judged(FOUND, "lost")
    lost = Match(MOTION, POINTS, 0.9, "lost", "why", measured=MEASURED)
    place.take(GraphUpdate({"loop_closures": 1}))
    assert place.judged(lost, NO_REASON, MapChange(segment=2), OF_GRAPH, 1, PRIOR).state == "degraded"
    place.graph_ended()
    assert place.judged(lost, NO_REASON, MapChange(segment=2), OF_GRAPH, 1, PRIOR).state == "lost"
    assert place.pose_map_odom == OF_GRAPH


def prediction(x_m: float, increment: OdometryIncrement | None = None) -> Prediction:
    twist = (SPEED_MPS, 0.0, 0.0)
    return Prediction(
        SE2(x_m), twist, NO, NO, NO, STEP_S, 0.0, is_measured=increment is not None, increment=increment
    )


def on_segment(
    speed_mps: float, increment: OdometryIncrement | None = None, scans: int = 50
) -> list[tuple[Prediction, float]]:
    """Scans at SPEED_MPS contradict the map; on the segment that they begin the speed is speed_mps."""
    motion, seen = SegmentMotion(), []
    for k in range(scans):
        predicted, unmeasured_s = motion.predicted(
            k * STEP_NS, prediction(k * STEP_S * speed_mps, increment if k else None)
        )
        motion.matched(k * STEP_NS, predicted, is_paused=False, is_on_map=False)
        seen.append((predicted, unmeasured_s))
    return seen


def test_a_segment_on_which_the_vehicle_goes_on_stands_still() -> None:
    for predicted, unmeasured_s in on_segment(SPEED_MPS)[1:]:
        assert unmeasured_s == 0.0
        np.testing.assert_allclose(predicted.segment_covariance, 0.0, atol=1e-12)


def test_a_segment_on_which_the_vehicle_stops_at_once_may_move_with_it() -> None:
    seen = on_segment(0.0)
    since_s = [unmeasured_s for _, unmeasured_s in seen if unmeasured_s]
    assert since_s == [pytest.approx(math.ceil(MAX_SIGMA_M / SPEED_MPS / STEP_S) * STEP_S)]  # reported once
    assert seen[2][0].segment_covariance[0, 0] == pytest.approx((2 * STEP_S * SPEED_MPS) ** 2)
    assert seen[-1][0].segment_covariance[0, 0] == UNKNOWN_SIGMA_M**2


def test_odometry_measures_the_motion_on_any_segment() -> None:
    for predicted, unmeasured_s in on_segment(0.0, ODOMETRY):
        assert unmeasured_s == 0.0
        assert predicted.segment_covariance is None


def test_a_scan_on_the_map_ends_the_comparison() -> None:
    motion = SegmentMotion()
    for k, is_on_map in ((0, False), (1, True), (50, False)):
        predicted, unmeasured_s = motion.predicted(k * STEP_NS, prediction(0.0))
        motion.matched(k * STEP_NS, predicted, False, is_on_map)
        assert unmeasured_s == 0.0


def test_after_a_pause_of_all_sensors_the_segment_is_not_begun_once_more() -> None:
    motion = SegmentMotion()
    paused = replace(prediction(0.0), pause_s=MAX_UNMEASURED_S + 1.0)
    motion.matched(0, paused, is_paused=True, is_on_map=False)
    for k in range(1, 50):
        predicted, unmeasured_s = motion.predicted(k * STEP_NS, prediction(0.0))
        motion.matched(k * STEP_NS, predicted, is_paused=False, is_on_map=False)
        assert unmeasured_s == 0.0
        assert predicted.segment_covariance is None
