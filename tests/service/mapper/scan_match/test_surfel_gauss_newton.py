import math
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from service.estimator.motion import Measurement, Prediction
from service.geometry.se2 import SE2
from service.mapper.components import Match, Points
from service.mapper.profiles import build_mapper, mapping_config
from service.mapper.scan_match.posts import walls_seen
from service.mapper.scan_match.submaps import SubmapsConfig, SurfelSubmaps
from service.mapper.scan_match.surfel_gauss_newton import SurfelGaussNewton, SurfelMatcherConfig
from tests.recorded_drive import frames_of
from tests.service.mapper.drives import outputs_of
from tests.service.mapper.maps.points import match_at, points_of, prediction, square


def new_matcher() -> SurfelGaussNewton:
    return SurfelGaussNewton(SurfelMatcherConfig())


def mapped(points: Points) -> SurfelSubmaps:
    chain = SurfelSubmaps(SubmapsConfig())
    for _ in range(5):
        chain.insert(points, match_at(SE2(), points, submap=0))
    return chain


def predicted(pose: SE2, sigma: float = 0.05, is_measured: bool = True) -> Prediction:
    moving = {
        "twist_base": (0.1, 0.0, 0.0),
        "twist_covariance": 10.0 * sigma**2 * np.eye(3),
        "travel_m": 0.01,
    }
    return prediction(pose, np.diag([sigma**2] * 3), is_measured=is_measured, **moving)


def match(points: Points, pose: SE2, chain: SurfelSubmaps, is_measured: bool = True) -> Match:
    return new_matcher().match(points, predicted(pose, is_measured=is_measured), chain)


def test_a_noisy_laser_does_not_spoil_the_walls_of_a_good_one() -> None:
    """Walls that a laser of 4 cm puts 4 cm aside move by the 17th part of that, not by half."""
    chain = mapped(square()._replace(range_sigma_m=0.01))
    aside = square()._replace(xy_base=square().xy_base + np.array([0.04, 0.0]), range_sigma_m=0.04)
    for _ in range(5):
        chain.insert(aside, match_at(SE2(), aside, submap=0))
    pose = match(square()._replace(range_sigma_m=0.01), SE2(), chain).motion.pose_odom_base
    assert 0.0005 < pose.x_m < 0.005


def test_a_vehicle_that_was_lost_is_not_carried_back_onto_ground_that_no_one_knows() -> None:
    """Set down in another room, it drives off the ground that the map knows: nothing contradicts there."""
    chain, matcher = mapped(square()), new_matcher()
    assert lost_at(chain, matcher, square(8.0), predicted(SE2(), sigma=0.005)).state == "lost"
    for k in range(5):
        far = predicted(SE2(30.0 + 0.1 * k, 0.0, 0.0), sigma=0.005)
        assert lost_at(chain, matcher, square(8.0), far).state == "lost"


def test_another_room_where_the_walls_of_this_one_should_be_seen_is_lost() -> None:
    """Carried there with the wheels off the floor: beams end behind the walls that stand around."""
    result = match(square(8.0), SE2(), mapped(square()))
    assert result.state == "lost"
    assert "behind its walls" in result.reason


def test_after_a_pause_in_which_no_one_saw_the_motion_a_scan_has_to_lie_on_the_map() -> None:
    """Half of the room is another: new ground with odometry, not after 5 s without odometry."""
    xy = square().xy_base
    opened = points_of(np.where((np.abs(np.arctan2(xy[:, 1], xy[:, 0])) < 1.95)[:, None], 3.5 * xy, xy))
    seen = replace(predicted(SE2(0.02, 0.0, 0.0)), elapsed_s=5.0)
    assert new_matcher().match(opened, seen, mapped(square())).state == "degraded"
    unseen = replace(seen, pause_s=5.0)
    assert new_matcher().match(opened, unseen, mapped(square())).state == "lost"
    assert new_matcher().match(square(), unseen, mapped(square())).state == "ok"


def test_where_no_one_measured_the_motion_the_map_is_asked_again_when_the_graph_has_found_the_place() -> None:
    """The same walls prove nothing, for others may look alike."""
    chain, matcher, points = mapped(square()), new_matcher(), square()
    segments = []
    chain.detach(5.0)
    for _ in range(3):
        found = matcher.match(points, predicted(SE2(0.02, 0.0, 0.0)), chain)
        assert found.state == "lost"
        assert found.reason.startswith(
            "neither laser nor odometry measured the motion for 5.0 s (at most 4 s;"
        )
        segments.append(chain.insert(points, found).segment)
    assert segments == [1, 1, 1]
    chain.detach(4.0)  # carried once more: another segment
    assert chain.insert(points, matcher.match(points, predicted(SE2()), chain)).segment == 2
    chain.join(1)
    assert matcher.match(points, predicted(SE2()), chain).state == "lost"
    chain.join(2)
    assert matcher.match(points, predicted(SE2()), chain).state == "ok"


def test_walls_in_what_was_free_are_another_place() -> None:
    """The same share of the returns lies on the map as on new ground, the rest contradicts."""
    xy = square().xy_base
    nearer = np.where((np.abs(np.arctan2(xy[:, 1], xy[:, 0])) < 1.95)[:, None], 0.5 * xy, xy)
    result = match(points_of(nearer), SE2(0.02, 0.0, 0.0), mapped(square()))
    assert result.state == "lost"
    assert "in its free space" in result.reason
    assert result.motion.pose_odom_base == SE2(0.02, 0.0, 0.0)


def test_what_the_scan_says_alone_does_not_depend_on_the_prediction() -> None:
    chain = mapped(square())
    loose, tight = (
        new_matcher().match(square(), predicted(SE2(), sigma), chain).measured for sigma in (0.3, 0.001)
    )
    assert loose is not None
    assert tight is not None
    np.testing.assert_allclose(loose.information, tight.information, rtol=0.01, atol=5e3)
    assert tight.covariance[0, 0] < 0.5 * loose.covariance[0, 0]


def test_a_prediction_that_is_many_sigmas_off_is_believed_less() -> None:
    chain = mapped(square())
    near, far = (
        new_matcher().match(square(), predicted(SE2(x_m, 0.0, 0.0), 0.02), chain).measured
        for x_m in (0.01, 0.12)
    )
    assert near is not None
    assert far is not None
    assert near.prior_weight == 1.0
    assert far.prior_weight == pytest.approx(8.0 / (5.0 + 36.0), rel=0.05)
    assert abs(far.pose_odom_base.x_m) < 0.01


def lost_at(chain: SurfelSubmaps, matcher: SurfelGaussNewton, points: Points, start: Prediction) -> Match:
    """One scan, matched and put into the map."""
    result = matcher.match(points, start, chain)
    chain.insert(result.points, result)
    return result


def test_lost_scans_are_matched_to_the_detached_segment_and_stay_lost() -> None:
    chain, matcher, far = mapped(square()), new_matcher(), square(3.0)
    assert lost_at(chain, matcher, far, predicted(SE2(50.0, 0.0, 0.0), is_measured=False)).measured is None
    result = lost_at(chain, matcher, far, predicted(SE2(50.03, 0.0, 0.01), is_measured=False))
    assert (result.state, result.submap) == ("lost", 1)
    assert "a detached segment begins here" in result.reason
    assert isinstance(result.measured, Measurement)
    assert abs(result.measured.pose_odom_base.x_m - 50.0) < 1e-3
    chain.join(1)
    result = matcher.match(far, predicted(SE2(50.03, 0.0, 0.01)), chain)
    assert (result.state, result.submap) == ("ok", 1)


def test_back_on_the_map_the_gap_of_the_detached_segment_is_reported() -> None:
    """Across the segment the pose was known to 0.2 m only, unlike in the estimator."""
    chain, matcher = mapped(square()), new_matcher()
    lost_at(chain, matcher, square(8.0), predicted(SE2(0.2, 0.0, 0.0), sigma=0.2))
    assert chain.detached is not None
    result = lost_at(chain, matcher, square(), predicted(SE2(0.2, 0.0, 0.0), sigma=0.01))
    assert result.state == "ok"
    assert abs(result.motion.pose_odom_base.x_m) < 0.01
    assert result.measured is not None
    assert result.measured.gap is not None
    np.testing.assert_allclose(result.measured.gap, 0.2**2 * np.eye(3), atol=1e-3)
    assert chain.detached is None


def test_too_far_for_the_motion_since_it_was_lost_a_fit_is_not_believed() -> None:
    chain, matcher = mapped(square()), new_matcher()
    lost_at(chain, matcher, square(8.0), predicted(SE2(0.6, 0.0, 0.0), sigma=0.02))
    result = lost_at(chain, matcher, square(), predicted(SE2(0.6, 0.0, 0.0), sigma=0.02))
    assert result.state == "lost"


def test_the_points_come_back_deskewed_with_the_matched_twist() -> None:
    """Seen while driving at 1 m/s, predicted as standing: the match must notice and straighten the walls."""
    still = square()
    time_s = np.linspace(0.0, 0.1, len(still.xy_base))
    raw = still.xy_base - np.outer(time_s, [1.0, 0.0])
    skewed = still._replace(xy_base=raw.copy(), xy_raw=raw, beam_time_s=time_s)
    standing = replace(predicted(SE2(-0.1, 0.0, 0.0), sigma=0.2), twist_base=(0.0, 0.0, 0.0))
    result = new_matcher().match(skewed, standing, mapped(still))
    assert abs(result.motion.pose_odom_base.x_m) < 0.002
    np.testing.assert_allclose(result.motion.twist_base, [1.0, 0.0, 0.0], atol=0.03)
    np.testing.assert_allclose(result.points.xy_base, still.xy_base, atol=0.004)


def test_a_compared_scan_of_new_ground_is_not_shifted_onto_similar_walls() -> None:
    """The map knows one end of a corridor, the scan the other: moved along it, all of it lies on the map."""
    known, seen = (
        points_of(np.vstack([np.column_stack((x_m, np.full(150, y_m))) for y_m in (1.0, -1.0)]))
        for x_m in (np.linspace(-4.0, 0.2, 150), np.linspace(0.2, 2.0, 150))
    )
    result = new_matcher().compare(seen, predicted(SE2(), sigma=0.1), mapped(known))
    assert abs(result.motion.pose_odom_base.x_m) < 0.05


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


def test_the_matcher_keeps_nothing_of_a_scan_that_is_compared() -> None:
    chain, matcher = mapped(nook()), new_matcher()
    for k in range(3):
        matcher.match(nook(), predicted(SE2(0.01 * k, 0.0, 0.0), sigma=0.02), chain)
    before = pickle.dumps(matcher)
    for seen, state in ((nook(), "ok"), (square(6.0), "lost")):
        assert matcher.compare(seen, predicted(SE2(0.05, 0.03, 0.04), sigma=0.1), chain).state == state
        assert pickle.dumps(matcher) == before


def test_the_whole_window_is_searched_twice_a_second_at_most() -> None:
    matcher, chain, frozen = new_matcher(), mapped(nook()), predicted(SE2(0.6, -0.4, 1.2), sigma=0.02)
    elsewhere = square(8.0)

    def state_at(stamp_ns: int, points: Points) -> str:
        scan = replace(points.scan, stamp_ns=stamp_ns)
        return matcher.match(points._replace(scan=scan), frozen, chain).state

    assert state_at(10**9, elsewhere) == "lost"  # searched in vain
    assert state_at(10**9 + 499_999_999, nook()) == "lost"
    assert state_at(10**9 + 500_000_000, nook()) == "ok"


def test_points_are_matched_where_their_beams_meet_walls_and_come_back_as_they_were_measured() -> None:
    room, noise = square(), np.random.default_rng(6)
    beams = room.xy_base / np.hypot(*room.xy_base.T)[:, None]
    noisy = points_of(room.xy_base + 0.04 * noise.standard_normal((len(beams), 1)) * beams)
    noisy = noisy._replace(range_sigma_m=0.04)
    chain = mapped(room)
    assert np.abs(walls_seen(noisy, np.zeros(1)).on_walls.xy_base - noisy.xy_base).max() > 0.02
    found = match(noisy, SE2(), chain)
    assert found.state == "ok"
    np.testing.assert_allclose(found.points.xy_base, noisy.xy_base, atol=1e-9)
    np.testing.assert_array_equal(found.points.xy_raw, noisy.xy_raw)


@pytest.mark.parametrize(("travel_m", "speed_mps", "oks"), [(0.0, 0.0, 4), (0.04, 0.0, 2), (0.04, 1.0, 1)])
def test_a_direction_is_open_once_the_vehicle_can_have_left_where_it_was_fixed(
    travel_m: float, speed_mps: float, oks: int
) -> None:
    """By odometry in each 0.1 s, or by its speed when the last scan fixed the position; and by inertia."""
    room, chain, matcher = square(), mapped(square()), new_matcher()
    walls = points_of(room.xy_base[np.abs(room.xy_base[:, 1]) > 1.99])
    seen = replace(predicted(SE2()), travel_m=travel_m, twist_base=(speed_mps, 0.0, 0.0))
    scans = (room, *5 * (walls,), room, walls)
    states = [matcher.match(points, seen, chain).state for points in scans]
    assert states == ["ok", *oks * ("ok",), *(5 - oks) * ("degraded",), "ok", "ok"]


def test_odometry_that_repeats_a_pose_and_jumps_does_not_turn_the_map(shared: Path) -> None:
    """After 56 s odometry lacks 0.85 m and 50 deg, in 1.7 s without a scan."""
    folder = shared / "datasets" / "csail"
    mapper = build_mapper(mapping_config(), {"scan": SE2()})
    outputs = outputs_of(mapper, frames_of(folder / "csail.mcap", 72))
    reference = np.loadtxt(folder / "ref.csv")
    begin_ns = outputs[0].stamp_ns
    before, after = (next(o for o in outputs if o.stamp_ns > begin_ns + s * 1_000_000_000) for s in (50, 71))
    ours = before.pose_map_base.inverse() @ after.pose_map_base
    rows = reference[:, 0].searchsorted([before.stamp_ns * 1e-9 - 0.01, after.stamp_ns * 1e-9 - 0.01])
    true_before, true_after = (SE2(*reference[row, 1:].tolist()) for row in rows)
    off = (true_before.inverse() @ true_after).inverse() @ ours
    assert math.hypot(off.x_m, off.y_m) < 0.5
    assert abs(off.theta_rad) < math.radians(6.0)
