"""Two rooms that differ by a pillar: in which of them a scan was taken, and when that is ambiguous."""

import math

import numpy as np
import pytest

from service.geometry import poses as se2
from service.geometry.se2 import SE2
from service.mapper.graph.model.keyframe_list import KeyframeList, LoopsConfig
from service.mapper.graph.model.loops import loop_of
from service.mapper.graph.relocalise.detached_search import CandidatePose, DetachedSearch
from service.mapper.graph.relocalise.expected_place import OdometryPrior
from service.mapper.graph.relocalise.known_map import MIN_MARGIN_NATS, UNEXPLAINED_SHARE, PlaceScore
from tests.service.mapper.graph.key_frames import APART_M, STOOD, append, room, rooms
from tests.service.mapper.graph.relocalise.evidence_margin import evidence_margin


def looked_for(keyframes: KeyframeList, own: int) -> tuple[DetachedSearch, tuple[np.ndarray, object] | None]:
    search = DetachedSearch(LoopsConfig(), keyframes)
    known = np.arange(own)
    return search, search.best_of(search.places_of([own], own, known))


@pytest.mark.parametrize("stands_in_second", [False, True])
def test_a_pillar_in_either_room_distinguishes_them(stands_in_second):
    """Seen in free space of the map; or missing where the map has it."""
    for pillar_in_second in (False, True):
        keyframes, noise = rooms(not pillar_in_second, pillar_in_second)
        at_m = APART_M if stands_in_second else 0.0
        walls = room(at_m, stands_in_second == pillar_in_second)
        pose = SE2(at_m + STOOD.x_m, STOOD.y_m, STOOD.theta_rad)
        search, best = looked_for(keyframes, append(keyframes, walls, pose, 1, noise))
        assert best is not None
        truth = np.array([pose.x_m, pose.y_m, pose.theta_rad])
        away = se2.between(truth, best[0])
        assert math.hypot(away[0], away[1]) < 0.02
        assert abs(away[2]) < 0.005
        assert evidence_margin(search, truth) > MIN_MARGIN_NATS
        in_the_other = truth + np.array([-APART_M if stands_in_second else APART_M, 0.0, 0.0])
        assert evidence_margin(search, in_the_other) < -MIN_MARGIN_NATS


def test_two_similar_rooms_are_both_candidates_and_none_is_accepted():
    keyframes, noise = rooms(pillar_in_first=False, pillar_in_second=False)
    search, best = looked_for(keyframes, append(keyframes, room(0.0, with_pillar=False), STOOD, 1, noise))
    assert best is None
    facts = sorted((at.x_m, at.y_m) for at in search.possible)
    assert facts[0] == pytest.approx((STOOD.x_m, STOOD.y_m), abs=0.05)
    assert facts[1] == pytest.approx((STOOD.x_m + APART_M, STOOD.y_m), abs=0.05)


@pytest.mark.parametrize("stands_in_second", [False, True])
def test_a_fully_mapped_room_does_not_win_against_a_partly_mapped_one(stands_in_second):
    """What the map does not know of the second may look as in the first."""
    noise, keyframes = np.random.default_rng(5), KeyframeList()
    for at_m, walls in ((0.0, room(0.0, with_pillar=False)), (APART_M, room(APART_M, with_pillar=False)[:5])):
        for x_m in np.arange(1.0, 5.5, 0.3):
            append(keyframes, walls, SE2(at_m + x_m, 1.2, 0.0), 0, noise)
    at_m = APART_M if stands_in_second else 0.0
    pose = SE2(at_m + STOOD.x_m, STOOD.y_m, STOOD.theta_rad)
    own = append(keyframes, room(at_m, with_pillar=False), pose, 1, noise)
    search, best = looked_for(keyframes, own)
    assert best is None
    facts = sorted((at.x_m, at.y_m) for at in search.possible)
    assert facts[0] == pytest.approx((STOOD.x_m, STOOD.y_m), abs=0.05)
    assert facts[1] == pytest.approx((STOOD.x_m + APART_M, STOOD.y_m), abs=0.05)
    assert evidence_margin(search, np.array([STOOD.x_m, STOOD.y_m, STOOD.theta_rad])) > MIN_MARGIN_NATS


def test_an_unmapped_room_is_not_found():
    keyframes, noise = rooms(pillar_in_first=True, pillar_in_second=False)
    hall = [(-9.0, -8.0, 9.0, -8.0), (9.0, -8.0, 9.0, 8.0), (9.0, 8.0, -9.0, 8.0), (-9.0, 8.0, -9.0, -8.0)]
    _, best = looked_for(keyframes, append(keyframes, hall, SE2(0.5, 0.3, 0.4), 1, noise))
    assert best is None


def test_unexplained_evidence_raises_the_required_margin():
    keyframes, _ = rooms(pillar_in_first=False, pillar_in_second=False)
    search = DetachedSearch(LoopsConfig(), keyframes)
    loop = loop_of(0, 1, np.zeros(3), np.eye(3), 0.9, 100, 0.0)

    def best_of(unexplained: float, ahead: float, beside_m: float = 5.0) -> object:
        best = CandidatePose(np.zeros(3), PlaceScore(500.0, unexplained, 0.0, 1.0), loop)
        other = CandidatePose(
            np.array([beside_m, 0.0, 0.0]), PlaceScore(500.0 - ahead, unexplained, 0.0, 1.0), loop
        )
        return search.best_of([other, best])

    for unexplained in (0.0, 60.0):
        ahead = MIN_MARGIN_NATS + UNEXPLAINED_SHARE * unexplained
        assert best_of(unexplained, 0.99 * ahead) is None
        assert [(at.x_m, at.y_m) for at in search.possible] == [(0.0, 0.0), (5.0, 0.0)]
        assert best_of(unexplained, 1.01 * ahead) is not None
        assert search.possible == []
    # Beside it the same is unexplained; and a pose as near as it is known is the same one.
    assert best_of(60.0, 1.01 * MIN_MARGIN_NATS, beside_m=0.3) is not None
    assert best_of(60.0, 0.99 * MIN_MARGIN_NATS, beside_m=0.3) is None
    assert best_of(60.0, 0.0, beside_m=0.05) is not None


def test_after_unmeasured_motion_a_place_must_exceed_new_ground_and_the_prior_counts() -> None:
    keyframes, _ = rooms(pillar_in_first=False, pillar_in_second=False)
    search = DetachedSearch(LoopsConfig(), keyframes)
    loop = loop_of(0, 1, np.zeros(3), np.eye(3), 0.9, 100, 0.0)
    prior = OdometryPrior(np.zeros(3), np.diag([0.03, 0.03, 0.01]) ** 2, 5000.0)

    def best_of(evidence: float, x_m: float, rival: float = -300.0) -> object:
        places = [
            CandidatePose(
                np.array([x, 0.0, 0.0]),
                PlaceScore(nats, 200.0, 0.0, 0.3),
                loop,
                prior.nats(np.array([x, 0, 0])),
            )
            for x, nats in ((x_m, evidence), (9.0, rival))
        ]
        return search.best_of(places, prior)

    led, elsewhere = 1.01 * MIN_MARGIN_NATS, 1.01 * (MIN_MARGIN_NATS + UNEXPLAINED_SHARE * 200.0)
    assert best_of(0.98 * led, 0.05) is None  # new ground may look so, too
    assert best_of(led, 0.05) is not None
    assert best_of(led, 5.0) is None  # carried: unexplained evidence counts against it
    assert best_of(elsewhere, 5.0) is not None
    # The prior counts at both places.
    ahead = prior.nats(np.array([0.05, 0.0, 0.0])) - prior.nats(np.array([9.0, 0.0, 0.0]))
    assert ahead > 10.0
    assert best_of(200.0, 0.05, rival=199.0 + ahead - MIN_MARGIN_NATS) is not None
    assert best_of(200.0, 0.05, rival=201.0 + ahead - MIN_MARGIN_NATS) is None
