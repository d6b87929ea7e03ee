import math

import numpy as np
import pytest

from service.mapper.judgement import Evidence, JudgementConfig, judge, sigmas_of

RATIOS = JudgementConfig()
GOOD = Evidence(
    used=500, on_map=480, in_free=5, sigma=(0.01, 0.002), prior=(0.05, 0.01), is_measured=True, is_far=False
)
NEW_GROUND = GOOD._replace(on_map=50, in_free=5)


def state(evidence: Evidence, **changes: object) -> str:
    return judge(evidence._replace(**changes), RATIOS)[0]  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, "degraded"),
        ({"behind": 90}, "degraded"),
        ({"behind": 91}, "lost"),  # 15 % and two sigma of 500: walls should be seen from there
        ({"in_free": 40, "behind": 51}, "lost"),
        ({"used": 10, "behind": 3}, "degraded"),
        ({"used": 10, "behind": 4}, "lost"),
        ({"used": 100, "on_map": 4, "in_free": 8}, "degraded"),  # four returns on the map are chance
        ({"used": 100, "on_map": 5, "in_free": 8}, "lost"),
        ({"on_map": 15, "behind": 400}, "degraded"),  # a door that opened: the rest of the room is there
        ({"is_measured": False}, "lost"),
        ({"is_in_doubt": True}, "lost"),
        ({"is_far": True}, "lost"),
        ({"prior": (0.6, 0.01)}, "lost"),
        ({"prior": (0.05, 0.5)}, "lost"),
    ],
)
def test_odometry_carries_the_pose_onto_unknown_ground(changes: dict[str, object], expected: str) -> None:
    unknown = GOOD._replace(on_map=0, in_free=0, behind=0)
    assert state(unknown, **changes) == expected


def test_once_a_scan_has_contradicted_the_map_walls_that_should_be_seen_count() -> None:
    back = GOOD._replace(on_map=170, in_free=70, behind=230)  # carried 5 m along a corridor of an office
    assert state(back) == "degraded"
    assert state(back, is_in_doubt=True) == "lost"
    assert state(back, behind=90, is_in_doubt=True) == "degraded"


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, "ok"),
        ({"behind": 90}, "ok"),
        ({"behind": 91}, "degraded"),  # 15 % and two sigma of 500
        ({"on_map": 149}, "degraded"),  # below the ratio at which a match is none without odometry
        ({"used": 60, "on_map": 25}, "ok"),
        ({"used": 45, "on_map": 19}, "degraded"),  # returns that confirm no place
        ({"is_measured": False}, "degraded"),
        ({"is_in_doubt": True}, "degraded"),
        ({"prior": (0.6, 0.01)}, "degraded"),
        ({"sigma": (0.16, 0.01)}, "degraded"),
        ({"weakest": (0.2, 0.0)}, "degraded"),
    ],
)
def test_new_ground_beside_walls_that_fix_the_pose_is_ok_where_nothing_contradicts(
    changes: dict[str, object], expected: str
) -> None:
    assert state(GOOD._replace(on_map=215, in_free=0, behind=0), **changes) == expected


def test_a_handful_of_returns_confirms_no_place() -> None:
    assert state(GOOD, used=20, on_map=20, in_free=0) == "ok"
    few, reason = judge(GOOD._replace(used=19, on_map=19, in_free=0), RATIOS)
    assert few == "degraded"
    assert reason.startswith("19 returns (expected at least 20)")


def test_returns_in_free_space_contradict_any_prediction() -> None:
    assert state(NEW_GROUND, in_free=60) == "lost"
    assert state(GOOD, on_map=240, in_free=200) == "ok"  # people close by
    assert state(GOOD, on_map=240, in_free=250) == "lost"
    reason = judge(GOOD._replace(on_map=240, in_free=250), RATIOS)[1]
    assert "in its free space (of those on known ground 49% on its walls, expected 50%)" in reason


def test_a_match_far_from_the_prediction_needs_more() -> None:
    assert state(GOOD, is_far=True) == "ok"
    assert state(GOOD, on_map=400, in_free=90) == "ok"
    assert state(GOOD, on_map=400, in_free=90, is_far=True) == "lost"
    assert state(GOOD, on_map=200, in_free=0, is_measured=False) == "degraded"
    assert state(GOOD, on_map=200, in_free=0, is_measured=False, is_far=True) == "lost"
    # 8 of 23 returns fitted 103 deg away from a heading that odometry knew to 1 deg
    assert state(GOOD, used=23, on_map=8, in_free=0) == "degraded"
    assert state(GOOD, used=23, on_map=8, in_free=0, is_far=True) == "lost"


@pytest.mark.parametrize(
    ("sigma", "expected"),
    [
        ((0.14, 0.05), "ok"),
        ((0.16, 0.01), "degraded"),
        ((0.01, 0.06), "degraded"),
        ((0.76, 0.01), "lost"),
        ((0.01, 0.36), "lost"),
    ],
)
def test_an_uncertain_pose_is_degraded_or_lost(sigma: tuple[float, float], expected: str) -> None:
    assert state(GOOD, sigma=sigma) == expected


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, "degraded"),
        ({"weakest": (0.05, 0.0)}, "lost"),  # the walls fix the position, and it is not known all the same
        ({"is_measured": False}, "degraded"),
        ({"is_far": True}, "lost"),
        ({"is_in_doubt": True}, "lost"),
        ({"in_free": 91}, "lost"),
        ({"sigma": (1.4, 0.36)}, "lost"),
    ],
)
def test_an_uncertain_position_along_an_open_direction_is_not_lost(
    changes: dict[str, object], expected: str
) -> None:
    slipped = GOOD._replace(sigma=(1.4, 0.01), prior=(1.4, 0.01), weakest=(5.0, 0.0), behind=0, in_free=0)
    assert state(slipped, **changes) == expected


@pytest.mark.parametrize(("open_m", "expected"), [(0.0, "ok"), (0.15, "ok"), (0.16, "degraded")])
def test_a_direction_that_was_fixed_a_moment_ago_is_not_open(open_m: float, expected: str) -> None:
    assert state(GOOD, weakest=(5.0, 0.0), open_m=open_m) == expected


@pytest.mark.parametrize("much", [185363.8, math.inf])
def test_a_sigma_that_measures_nothing_is_not_reported_as_a_number(much: float) -> None:
    reason = judge(GOOD._replace(weakest=(much, 0.5)), RATIOS)[1]
    assert "heading (sigma not known, expected at most 0.1 m)" in reason
    for sigma in ((much, 0.01), (0.01, much)):
        state_then, reason = judge(GOOD._replace(sigma=sigma), RATIOS)
        assert state_then == "lost"
        assert reason.startswith("the pose on the map is not known. Drive where")
    assert "sigma 0.20 m" in judge(GOOD._replace(weakest=(0.2, 0.5)), RATIOS)[1]
    assert (
        "uncertain by 0.80 m and 0.6 deg (sigma, expected at most 0.75 m and 20 deg)"
        in (judge(GOOD._replace(sigma=(0.8, 0.01)), RATIOS)[1])
    )


@pytest.mark.parametrize(
    ("direction_deg", "axis"),
    [(0.0, "0"), (0.4, "0"), (179.6, "0"), (180.0, "0"), (-0.3, "0"), (-1.0, "179"), (270.0, "90")],
)
def test_an_open_direction_is_an_axis_with_one_name(direction_deg: float, axis: str) -> None:
    reason = judge(GOOD._replace(weakest=(0.2, math.radians(direction_deg))), RATIOS)[1]
    assert f"the direction {axis} deg from" in reason


def test_the_sigma_of_a_position_is_that_of_its_worst_direction() -> None:
    turn = np.eye(3)
    turn[:2, :2] = [[math.cos(0.7), -math.sin(0.7)], [math.sin(0.7), math.cos(0.7)]]
    covariance = turn @ np.diag([0.3**2, 0.01**2, 0.02**2]) @ turn.T
    assert sigmas_of(covariance) == pytest.approx((0.3, 0.02))
