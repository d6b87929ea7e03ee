"""Two rooms that differ by a pillar: in which of them a scan was taken, and when that is ambiguous."""

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from service.geometry import poses as se2
from service.geometry.se2 import SE2
from service.kernels.beam_likelihood import MAX_LOG_RATIO
from service.kernels.loops import thin_points
from service.kernels.normals import estimate_normals
from service.mapper.graph.model.keyframe_list import KeyFrame, KeyframeList, ThinnedScan
from service.mapper.graph.model.loops import loop_of
from service.mapper.graph.model.loops_config import LoopsConfig
from service.mapper.graph.model.seen_cloud import SeenCloud, seen_cloud
from service.mapper.graph.relocalise.detached_search import CandidatePose, DetachedSearch
from service.mapper.graph.relocalise.known_map import (
    MAX_NATS_PER_WALL,
    MIN_MARGIN_NATS,
    UNEXPLAINED_SHARE,
    Aligned,
    KnownMap,
    PlaceScore,
    winning_nats,
)
from service.mapper.graph.relocalise.odometry_prior import OdometryPrior
from tests.service.mapper.drives import cast

Walls = list[tuple[float, float, float, float]]
APART_M = 30.0  # from one room to the other
FIRST_RAD, STEP_RAD, BEAMS = -0.75 * math.pi, math.radians(0.5), 541
PILLAR = (3.0, 2.2, 0.4)  # x, y of its corner and its edge, m


def room(at_m: float, with_pillar: bool) -> Walls:
    corners = [(0.0, 0.0), (7.0, 0.0), (7.0, 4.0), (5.0, 4.0), (5.0, 5.0), (0.0, 5.0), (0.0, 0.0)]
    walls = [(*a, *b) for a, b in pairwise(corners)]
    if with_pillar:
        x, y, edge = PILLAR
        corners = [(x, y), (x + edge, y), (x + edge, y + edge), (x, y + edge), (x, y)]
        walls += [(*a, *b) for a, b in pairwise(corners)]
    return [(x0 + at_m, y0, x1 + at_m, y1) for x0, y0, x1, y1 in walls]


def append(
    keyframes: KeyframeList,
    walls: Walls,
    pose: SE2,
    segment: int,
    noise: np.random.Generator,
    odom: SE2 | None = None,
    **motion: Any,
) -> int:
    """Append a key frame with the walls visible from a pose; its index. odom: its odometry pose, if
    different.

    motion   further fields of the key frame
    """
    angle = FIRST_RAD + STEP_RAD * np.arange(BEAMS)
    paths = np.column_stack((np.cos(angle + pose.theta_rad), np.sin(angle + pose.theta_rad)))
    range_m = cast(walls, np.tile([pose.x_m, pose.y_m], (BEAMS, 1)), paths)
    range_m = range_m + 0.012 * noise.standard_normal(BEAMS)
    angle, range_m = angle[np.isfinite(range_m)], range_m[np.isfinite(range_m)]
    xy = np.column_stack((range_m * np.cos(angle), range_m * np.sin(angle)))
    normals, kept = np.empty((len(xy), 3)), np.empty(len(xy), np.bool_)
    estimate_normals(xy, np.zeros(2), STEP_RAD, 0.012, 1.0, normals, np.empty((len(xy), 2)))
    thin_points(xy, 0.04, kept)
    nothing = np.zeros((0, 2), np.float32)
    odom = odom or pose
    frame = KeyFrame(
        keyframes.count, odom, np.eye(3), segment, 0.9, False, nothing, (0.0, 0.0), STEP_RAD, **motion
    )
    thinned = ThinnedScan(xy[kept].astype(np.float32), normals[kept].astype(np.float32), (0.0, 0.0))
    keyframes.append(frame, np.array([odom.x_m, odom.y_m, odom.theta_rad]), thinned)
    return keyframes.count - 1


def rooms(pillar_in_first: bool, pillar_in_second: bool) -> tuple[KeyframeList, np.random.Generator]:
    """A path through each of the two, both in the map."""
    noise, keyframes = np.random.default_rng(5), KeyframeList()
    for at_m, with_pillar in ((0.0, pillar_in_first), (APART_M, pillar_in_second)):
        for x_m in np.arange(1.0, 5.5, 0.3):
            append(keyframes, room(at_m, with_pillar), SE2(at_m + x_m, 1.2, 0.0), 0, noise)
    return keyframes, noise


STOOD = SE2(2.0, 3.1, 0.3)  # in a room, where no key frame was


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
        assert search.evidence_margin(truth) > MIN_MARGIN_NATS
        in_the_other = truth + np.array([-APART_M if stands_in_second else APART_M, 0.0, 0.0])
        assert search.evidence_margin(in_the_other) < -MIN_MARGIN_NATS


def test_two_similar_rooms_are_both_candidates_and_none_is_accepted():
    keyframes, noise = rooms(pillar_in_first=False, pillar_in_second=False)
    search, best = looked_for(keyframes, append(keyframes, room(0.0, with_pillar=False), STOOD, 1, noise))
    assert best is None
    facts = sorted((at.x_m, at.y_m) for at in search.possible)
    assert facts[0] == pytest.approx((STOOD.x_m, STOOD.y_m), abs=0.05)
    assert facts[1] == pytest.approx((STOOD.x_m + APART_M, STOOD.y_m), abs=0.05)


def test_neither_of_two_similar_rooms_is_refined(monkeypatch: pytest.MonkeyPatch):
    """No refinement would make one of them win."""
    refined: list[Aligned] = []
    refine = KnownMap.refine

    def counted(known_map: KnownMap, seen: SeenCloud, aligned: Aligned) -> Aligned:
        refined.append(aligned)
        return refine(known_map, seen, aligned)

    monkeypatch.setattr(KnownMap, "refine", counted)
    for with_pillar in (False, True):
        keyframes, noise = rooms(pillar_in_first=with_pillar, pillar_in_second=False)
        looked_for(keyframes, append(keyframes, room(0.0, with_pillar), STOOD, 1, noise))
        assert bool(refined) == with_pillar


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
    assert search.evidence_margin(np.array([STOOD.x_m, STOOD.y_m, STOOD.theta_rad])) > MIN_MARGIN_NATS


def test_an_unmapped_room_is_not_found():
    keyframes, noise = rooms(pillar_in_first=True, pillar_in_second=False)
    hall = [(-9.0, -8.0, 9.0, -8.0), (9.0, -8.0, 9.0, 8.0), (9.0, 8.0, -9.0, 8.0), (-9.0, 8.0, -9.0, -8.0)]
    _, best = looked_for(keyframes, append(keyframes, hall, SE2(0.5, 0.3, 0.4), 1, noise))
    assert best is None


def test_a_pillar_seen_in_free_space_contradicts_a_place():
    keyframes, noise = rooms(pillar_in_first=False, pillar_in_second=False)
    own = append(keyframes, room(0.0, with_pillar=True), STOOD, 1, noise)
    known_map = KnownMap(keyframes, np.arange(own))
    seen = seen_cloud(keyframes, [own], own)
    cloud = seen.cloud
    aligned = known_map.align(seen, np.array([STOOD.x_m + 0.1, STOOD.y_m - 0.1, STOOD.theta_rad]))
    score = aligned.score
    on_pillar = np.hypot(*(se2.points_from(aligned.fit.pose, cloud.xy) - (3.2, 2.4)).T) < 0.4
    assert 0.03 < on_pillar.mean() < 0.3
    assert score.against == pytest.approx(on_pillar.mean(), abs=0.03)
    count = len(cloud.xy)
    assert score.evidence / count == pytest.approx(1.55 - 7.3 * on_pillar.mean(), abs=0.15)
    assert score.unexplained == pytest.approx(MAX_LOG_RATIO * count - score.evidence)


def test_a_mapped_person_does_not_exclude_a_place():
    """The mapped person is around the sensor: each beam passes through."""
    noise, keyframes = np.random.default_rng(5), KeyframeList()
    for at_m in (0.0, APART_M):
        for x_m in np.arange(1.0, 5.5, 0.3):
            walls = room(at_m, with_pillar=at_m > 0.0)
            if at_m == 0.0 and 2.0 < x_m < 2.5:
                corners = [(1.8, 2.9), (2.2, 2.9), (2.2, 3.3), (1.8, 3.3), (1.8, 2.9)]
                walls = walls + [(*a, *b) for a, b in pairwise(corners)]
            append(keyframes, walls, SE2(at_m + x_m, 1.2, 0.0), 0, noise)
    _, best = looked_for(keyframes, append(keyframes, room(0.0, with_pillar=False), STOOD, 1, noise))
    assert best is not None
    away = se2.between(np.array([STOOD.x_m, STOOD.y_m, STOOD.theta_rad]), best[0])
    assert math.hypot(away[0], away[1]) < 0.02


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


def test_the_room_behind_a_wall_of_the_map_is_a_candidate():
    """From there the back of the wall is visible, and through the door the mapped room; a hall elsewhere
    looks more like it.
    """
    first = [(0.0, 0.0), (7.0, 0.0), (7.0, 3.0), (5.5, 3.0), (5.5, 4.0), (0.0, 4.0), (0.0, 0.0)]
    next_to_it = [(4.2, 4.1), (9.0, 4.1), (9.0, 9.0), (-1.0, 9.0), (-1.0, 4.1), (2.8, 4.1)]
    walls = [(*a, *b) for a, b in [*pairwise(first), *pairwise(next_to_it)] if (a, b) != (first[4], first[5])]
    walls += [(5.5, 4.0, 4.2, 4.0), (2.8, 4.0, 0.0, 4.0), (4.2, 4.0, 4.2, 4.1), (2.8, 4.0, 2.8, 4.1)]
    noise, keyframes = np.random.default_rng(5), KeyframeList()
    for x_m in np.arange(1.0, 5.5, 0.3):
        append(keyframes, walls, SE2(x_m, 1.2, 0.0), 0, noise)
    hall = [(29.0, 4.1), (39.0, 4.1), (39.0, 9.0), (29.0, 9.0), (29.0, 4.1)]
    for x_m in np.arange(31.0, 36.0, 0.5):
        append(keyframes, [(*a, *b) for a, b in pairwise(hall)], SE2(x_m, 5.5, 0.0), 0, noise)
    pose = np.array([3.4, 5.5, -0.4 * math.pi])
    own = append(keyframes, walls, SE2(*pose.tolist()), 1, noise)
    known_map = KnownMap(keyframes, np.arange(own))
    candidates = known_map.candidates(seen_cloud(keyframes, [own], own), 0.0)
    away = se2.between(pose, candidates[:, :3])
    assert (np.hypot(away[:, 0], away[:, 1]) + np.abs(away[:, 2])).min() < 0.3


def test_each_wall_counts_once_however_many_beams_end_on_it():
    keyframes, noise = rooms(pillar_in_first=False, pillar_in_second=False)
    mapped = np.arange(keyframes.count)
    truth = np.array([STOOD.x_m, STOOD.y_m, STOOD.theta_rad])
    own = [append(keyframes, room(0.0, with_pillar=is_there), STOOD, 1, noise) for is_there in (False, True)]
    known_map = KnownMap(keyframes, mapped)
    without, with_pillar = (known_map.structure(seen_cloud(keyframes, [k], k), truth) for k in own)
    assert 5.0 * MAX_NATS_PER_WALL < without < 13.0 * MAX_NATS_PER_WALL  # six walls, and stray points
    assert with_pillar < without - MAX_NATS_PER_WALL  # two sides of it are seen in free space
    elsewhere = known_map.structure(seen_cloud(keyframes, own[:1], own[0]), truth + np.array([0.5, 0.3, 0.0]))
    assert elsewhere < 0.0


HALL_M = 33.0


def in_the_middle_of_a_hall(known: Walls, new: Walls) -> tuple[KnownMap, SeenCloud, np.ndarray]:
    """A query there, the map by a path along the walls, and where the query was. known: of the map, besides
    the hall; new: seen by the query alone.
    """
    noise, keyframes, far_m = np.random.default_rng(6), KeyframeList(), HALL_M + 3.0
    corners = [(0.0, 0.0), (HALL_M, 0.0), (HALL_M, HALL_M), (21.0, HALL_M), (21.0, far_m), (0.0, far_m)]
    hall = [(*a, *b) for a, b in pairwise([*corners, corners[0]])] + known
    for side in range(4):
        for along_m in np.arange(-11.5, 11.5, 1.0):
            pose = SE2(0.5 * HALL_M, 0.5 * HALL_M, 0.5 * math.pi * side) @ SE2(along_m, -11.5, 0.0)
            append(keyframes, hall, pose, 0, noise)
    truth = SE2(16.5, 17.0, 0.3)
    own = append(keyframes, hall + new, truth, 1, noise)
    return KnownMap(keyframes, np.arange(own)), seen_cloud(keyframes, [own], own), np.array(truth)


def test_the_bound_of_a_candidate_includes_walls_beyond_the_reach_of_the_search():
    """A new board is near; most of what fits is far."""
    boxes = [(20.0, 14.0, 20.0, 18.0), (13.0, 19.0, 17.0, 19.0)]
    known_map, seen, truth = in_the_middle_of_a_hall(boxes, [(18.0, 13.5, 18.0, 14.5)])
    evidence = known_map.score(seen, truth).evidence
    assert evidence > winning_nats(seen.mass)
    places = known_map.candidates(seen, winning_nats(seen.mass))
    away = se2.between(truth, places[:, :3])
    is_there = (np.hypot(away[:, 0], away[:, 1]) < 1.0) & (abs(away[:, 2]) < 0.1)
    assert places[is_there, 3].max() >= evidence


def test_where_all_walls_are_beyond_the_reach_of_the_search_there_is_no_candidate():
    known_map, seen, _ = in_the_middle_of_a_hall([], [])
    assert len(seen.cloud.xy)
    assert len(known_map.candidates(seen, 0.0)) == 0
