"""Judging and recovery, around a matcher that does as it is asked."""

import math
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from service.estimator.motion import Measurement, Prediction
from service.geometry.se2 import SE2
from service.mapper.components import MapChange, Match, Overlap, Points
from service.mapper.judgement import JudgementConfig
from service.mapper.maps.known_ground import KnownGround
from service.mapper.matchers.judged import RESTART_M, UNCONFIRMED, Aligned, JudgedMatching
from tests.service.mapper.maps.points import points_of, prediction, square

ORIGIN = SE2()
SURE = np.diag([0.01**2, 0.01**2, 0.002**2])


class Ground:
    """KnownMap of nothing but known ground."""

    def __init__(self) -> None:
        self.start_over()

    def start_over(self) -> None:
        self.is_empty, self._ground = True, KnownGround()

    def insert(self, points: Points, match: Match) -> MapChange:
        self.is_empty = False
        self._ground.insert(points, match.motion.pose_odom_base)
        return MapChange(is_keyframe=True)

    def overlap(self, xy_base: np.ndarray, pose: SE2) -> Overlap:
        return self._ground.overlap(xy_base, pose)

    def join(self, segment: int) -> None: ...


@dataclass
class Reported:
    """Laying that confirms the prediction, off and finding as it is asked."""

    off: SE2 = ORIGIN
    finds: list[SE2] = field(default_factory=list)
    asked: list[tuple[float, float]] = field(default_factory=list)

    def align(self, points: Points, predicted: Prediction, local_map: Ground, is_found: bool) -> Aligned:
        pose = predicted.pose_odom_base if is_found else predicted.pose_odom_base @ self.off
        return Aligned(Measurement(pose, SURE, np.linalg.inv(SURE), is_joined=False), points)

    def search(self, points: Points, local_map: Ground, pose: SE2, reach: tuple[float, float]) -> SE2 | None:
        self.asked.append(reach)
        return self.finds.pop(0) if self.finds else None


def predicted(pose: SE2, travel_m: float = 0.1) -> Prediction:
    return prediction(pose, np.diag([0.05**2, 0.05**2, 0.02**2]), travel_m=travel_m)


def at(points: Points, stamp_s: float) -> Points:
    return points._replace(scan=replace(points.scan, stamp_ns=round(stamp_s * 1e9)))


@pytest.fixture
def room() -> Ground:
    ground = Ground()
    begun = JudgedMatching(JudgementConfig()).match(square(), predicted(SE2()), ground, Reported())
    assert (begun.state, begun.inlier_ratio, begun.measured) == ("ok", 1.0, None)
    ground.insert(square(), begun)
    return ground


def opened() -> Points:
    """A quarter of the square; the rest far behind where its walls were."""
    xy = square().xy_base
    return points_of(np.where((np.abs(np.arctan2(xy[:, 1], xy[:, 0])) < 2.4)[:, None], 4.0 * xy, xy))


@pytest.mark.parametrize(("is_measured", "state"), [(True, "degraded"), (False, "lost")])
def test_on_new_ground_the_prediction_stands_if_it_was_measured(
    room: Ground, is_measured: bool, state: str
) -> None:
    here = replace(predicted(SE2()), is_measured=is_measured)
    match = JudgedMatching(JudgementConfig()).match(opened(), here, room, Reported(off=SE2(0.05, 0.0, 0.0)))
    assert match.state == state
    assert "returns lie on the map" in match.reason
    assert match.motion.pose_odom_base == SE2()
    assert match.measured is None


def test_a_find_far_away_is_believed_when_the_next_says_the_same(room: Ground) -> None:
    matching, away = JudgedMatching(JudgementConfig()), predicted(SE2(3.0, 1.5, 1.0))
    facts = Reported(finds=[SE2(), SE2(0.02, 0.01, 0.0)])
    first = matching.match(at(square(), 1.0), away, room, facts)
    assert (first.state, first.measured) == ("lost", None)
    assert matching.match(at(square(), 1.09), away, room, facts).state == "lost"  # not searched again yet
    second = matching.match(at(square(), 1.1), away, room, facts)
    assert second.state == "ok"
    assert second.measured is not None
    assert second.measured.pose_odom_base == SE2(0.02, 0.01, 0.0)
    assert second.measured.prior_weight < 0.01
    assert not second.measured.is_joined


@pytest.mark.parametrize(("turned_rad", "state"), [(0.0, "ok"), (math.pi / 2, "lost")])  # it is a square
def test_after_lost_scans_two_have_to_agree_where_the_prediction_says_little(
    room: Ground, turned_rad: float, state: str
) -> None:
    matching, facts = JudgedMatching(JudgementConfig()), Reported()
    here = replace(predicted(SE2()), local_covariance=np.diag([0.8**2, 0.8**2, 1.0**2]))
    assert matching.match(at(points_of(square().xy_base[:4]), 1.0), here, room, facts).state == "lost"
    first = matching.match(at(square(), 1.1), here, room, facts)
    assert (first.state, first.reason, first.measured) == ("lost", UNCONFIRMED, None)
    facts.off = SE2(0.0, 0.0, turned_rad)
    assert matching.match(at(square(), 1.2), here, room, facts).state == state


def test_a_search_in_vain_makes_the_next_twice_as_wide(room: Ground) -> None:
    matching, away, facts = JudgedMatching(JudgementConfig()), predicted(SE2(3.0, 1.5, 1.0)), Reported()
    for k in range(26):
        matching.match(at(square(), 1.0 + 0.1 * k), away, room, facts)
    assert facts.asked == [(2.0, 1.6), (4.0, math.pi), (8.0, math.pi), (8.0, math.pi)]


def lost_over(metres: float, room: Ground, scans: list[Points]) -> list[Match]:
    """A vehicle whose wheels say that it drove on, out of the room; it sees `scans`, again and again."""
    matching = JudgedMatching(JudgementConfig())
    matches = []
    for k in range(1, math.ceil(metres) + 1):
        here = predicted(SE2(3.0, 1.5, 1.0), travel_m=1.0)
        matches.append(matching.match(at(scans[k % len(scans)], float(k)), here, room, Reported()))
    return matches


def test_a_vehicle_that_is_not_found_over_a_long_path_begins_its_map_again(room: Ground) -> None:
    matches = lost_over(RESTART_M, room, [square()])
    assert [match.state for match in matches[:-1]] == ["lost"] * (len(matches) - 1)
    assert matches[-1].state == "degraded"
    assert "a new map begins here" in matches[-1].reason
    assert matches[-1].measured is None
    assert room.is_empty


def test_noise_begins_no_map(room: Ground) -> None:
    noise = np.random.default_rng(1)
    scans = [
        points_of(square().xy_base * noise.uniform(0.2, 3.0, (len(square().xy_base), 1))) for _ in range(5)
    ]
    assert {match.state for match in lost_over(3.0 * RESTART_M, room, scans)} == {"lost"}
    assert not room.is_empty
