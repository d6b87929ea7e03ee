import math
from dataclasses import replace

import numpy as np
import pytest

from service.fusion.motion import Matched, Prediction
from service.geometry.se2 import SE2
from service.mapper.maps.submaps import SubmapsConfig, SurfelSubmaps
from service.mapper.matchers.surfel_gauss_newton import SurfelGaussNewton, SurfelMatcherConfig
from service.mapper.stages import Match, Points
from tests.service.mapper.maps.points import match_at, points_of, square


def new_matcher() -> SurfelGaussNewton:
    return SurfelGaussNewton(SurfelMatcherConfig())


def mapped(points: Points) -> SurfelSubmaps:
    chain = SurfelSubmaps(SubmapsConfig())
    for _ in range(5):
        chain.insert(points, match_at(SE2(), points, submap=0))
    return chain


def predicted(pose: SE2, sigma: float = 0.05) -> Prediction:
    covariance = np.diag([sigma**2] * 3)
    return Prediction(
        pose, (0.1, 0.0, 0.0), covariance, covariance, elapsed_s=0.1, twist_gain=1.0, is_measured=True
    )


def match(points: Points, pose: SE2, chain: SurfelSubmaps) -> Match:
    return new_matcher().match(points, predicted(pose), chain)


def test_a_scan_of_the_same_room_is_put_where_it_belongs() -> None:
    result = match(square(), SE2(0.04, -0.03, 0.02), mapped(square()))
    pose = result.motion.pose_odom_base
    np.testing.assert_allclose([pose.x_m, pose.y_m, pose.theta_rad], 0.0, atol=5e-4)
    assert (result.state, result.reason, result.submap) == ("ok", "", 0)
    assert result.score > 0.95


def test_the_first_scan_defines_the_map() -> None:
    empty = SurfelSubmaps(SubmapsConfig())
    result = match(square(), SE2(), empty)
    assert (result.motion.pose_odom_base, result.state, result.score) == (SE2(), "ok", 1.0)


def test_a_room_that_is_not_on_the_map_is_lost_and_keeps_the_prediction() -> None:
    pose = SE2(30.0, 0.0, 0.2)
    result = match(square(), pose, mapped(square()))
    assert result.state == "lost"
    assert result.motion.pose_odom_base == pose
    assert result.motion.twist_base == (0.1, 0.0, 0.0)
    assert "0% of 360 returns lie on the map (at least 30%)" in result.reason


def test_where_half_the_room_was_rebuilt_the_match_is_degraded() -> None:
    xy = square().xy_base
    rebuilt = np.where((np.abs(np.arctan2(xy[:, 1], xy[:, 0])) < 1.95)[:, None], 3.5 * xy, xy)
    result = match(points_of(rebuilt), SE2(), mapped(square()))
    assert result.state == "degraded"
    assert "expected 45%" in result.reason


def half_hidden() -> Points:
    """The square with someone before a third of it."""
    xy = square().xy_base
    return points_of(np.where((np.abs(np.arctan2(xy[:, 1], xy[:, 0])) < 1.0)[:, None], 0.4 * xy, xy))


@pytest.mark.parametrize("is_measured", [False, True])
def test_a_jump_is_refused_where_few_walls_ask_for_it_of_a_guessed_speed(is_measured: bool) -> None:
    start = replace(predicted(SE2(0.12, 0.0, 0.0), sigma=0.02), is_measured=is_measured)
    result = new_matcher().match(half_hidden(), start, mapped(square()))
    assert (result.state == "lost") != is_measured
    if is_measured:
        assert abs(result.motion.pose_odom_base.x_m) < 0.02
    else:
        assert result.motion.pose_odom_base == start.pose_odom_base
        assert "from the prediction" in result.reason
        assert "usual 100%" in result.reason


def test_a_jump_is_believed_where_all_walls_agree() -> None:
    start = replace(predicted(SE2(0.12, 0.0, 0.0), sigma=0.02), is_measured=False)
    result = new_matcher().match(square(), start, mapped(square()))
    assert result.state == "ok"
    assert abs(result.motion.pose_odom_base.x_m) < 0.02


def test_too_few_returns_name_the_sensor_and_what_to_look_at() -> None:
    result = match(points_of(square().xy_base[:7]), SE2(), mapped(square()))
    assert result.state == "lost"
    assert result.reason.startswith("front: 7 of 7 beams returned (at least 20)")


def test_a_detached_submap_is_tried_where_the_old_one_fails() -> None:
    chain = mapped(square())
    far = square(3.0)
    chain.insert(far, match_at(SE2(50.0, 0.0, 0.0), far, "lost"))
    result = match(far, SE2(50.03, 0.0, 0.01), chain)
    assert (result.state, result.submap) == ("ok", 1)
    assert isinstance(result.motion, Matched)
    assert result.motion.on_new_map
    assert abs(result.motion.pose_odom_base.x_m - 50.0) < 1e-3


def test_the_points_come_back_deskewed_with_the_matched_twist() -> None:
    """Seen while driving at 1 m/s, predicted as standing: the match must notice and straighten the walls."""
    still = square()
    time_s = np.linspace(0.0, 0.1, len(still.xy_base))
    raw = still.xy_base - np.outer(time_s, [1.0, 0.0])
    skewed = replace(still, xy_base=raw.copy(), xy_raw=raw, beam_time_s=time_s)
    standing = replace(predicted(SE2(-0.1, 0.0, 0.0), sigma=0.2), twist_base=(0.0, 0.0, 0.0))
    result = new_matcher().match(skewed, standing, mapped(still))
    assert abs(result.motion.pose_odom_base.x_m) < 0.002
    np.testing.assert_allclose(result.motion.twist_base, [1.0, 0.0, 0.0], atol=0.03)
    np.testing.assert_allclose(result.points.xy_base, still.xy_base, atol=0.004)


def test_covariance_never_claims_more_than_its_floor() -> None:
    covariance = match(square(), SE2(), mapped(square())).motion.covariance
    assert (np.sqrt(np.diag(covariance)) >= [0.002, 0.002, 0.0003]).all()
    assert math.sqrt(covariance[0, 0]) < 0.02


def mostly_new() -> Points:
    """A fifth of the square, the rest far behind where its walls were."""
    xy = square().xy_base
    return points_of(np.where((np.abs(np.arctan2(xy[:, 1], xy[:, 0])) < 2.5)[:, None], 3.5 * xy, xy))


@pytest.mark.parametrize(
    ("is_measured", "away_m", "state"), [(True, 0.03, "degraded"), (False, 0.03, "lost")]
)
def test_few_points_are_believed_where_measured_wheels_say_the_same(
    is_measured: bool, away_m: float, state: str
) -> None:
    start = replace(predicted(SE2(away_m, 0.0, 0.0), sigma=0.02), is_measured=is_measured)
    result = new_matcher().match(mostly_new(), start, mapped(square()))
    assert 0.15 < result.score < 0.3
    assert result.state == state
    if is_measured:
        assert abs(result.motion.pose_odom_base.x_m) < 0.01
        assert result.reason.endswith("but the wheels say the same")


def nook() -> Points:
    """A room that looks like itself from nowhere else: one corner of the square is cut off, one is deep."""
    xy = square().xy_base
    bearing = np.arctan2(xy[:, 1], xy[:, 0])
    scale = np.where(np.abs(bearing - 0.9) < 0.5, 0.6, np.where(np.abs(bearing + 2.0) < 0.4, 1.5, 1.0))
    return points_of(scale[:, None] * xy)


def test_a_vehicle_that_turned_while_its_wheels_were_silent_is_found_again() -> None:
    frozen = predicted(SE2(0.6, -0.4, 1.2), sigma=0.02)
    result = new_matcher().match(nook(), frozen, mapped(nook()))
    pose = result.motion.pose_odom_base
    assert result.state == "ok"
    np.testing.assert_allclose([pose.x_m, pose.y_m, pose.theta_rad], 0.0, atol=2e-3)


def test_the_whole_window_is_searched_once_a_second_at_most() -> None:
    matcher, chain, frozen = new_matcher(), mapped(nook()), predicted(SE2(0.6, -0.4, 1.2), sigma=0.02)
    elsewhere = square(8.0)

    def state_at(stamp_ns: int, points: Points) -> str:
        scan = replace(points.scan, stamp_ns=stamp_ns)
        return matcher.match(replace(points, scan=scan), frozen, chain).state

    assert state_at(10**9, elsewhere) == "lost"  # searched in vain
    assert state_at(2 * 10**9 - 1, nook()) == "lost"
    assert state_at(2 * 10**9, nook()) == "ok"


def half_a_nook() -> Points:
    """The nook with two thirds of it behind newly made room."""
    xy = nook().xy_base
    return points_of(np.where((np.arctan2(xy[:, 1], xy[:, 0]) > -0.75)[:, None], 2.6 * xy, xy))


def test_a_far_jump_needs_more_than_a_near_one() -> None:
    chain = mapped(nook())
    near = predicted(SE2(0.02, 0.0, 0.0), sigma=0.02)
    there = new_matcher().match(half_a_nook(), near, chain)
    assert 0.3 < there.score < 0.45
    assert there.state == "degraded"
    far = predicted(SE2(0.6, -0.4, 1.2), sigma=0.02)
    result = new_matcher().match(half_a_nook(), far, chain)
    assert result.state == "lost"
    bold = SurfelGaussNewton(SurfelMatcherConfig(degraded_share=0.3))
    assert bold.match(half_a_nook(), far, chain).state != "lost"
