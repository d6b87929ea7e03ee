"""Where in a known map a cloud may lie: candidates, each climbed to the likeliest pose near it."""

import math
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.mapper.graph.model.seen_cloud import SeenCloud
from service.mapper.graph.relocalise.known_map import Aligned, KnownMap

SAME_PLACE_M, SAME_PLACE_RAD = 0.5, 0.1  # poses that mean one room
SAME_POSE_M, SAME_POSE_RAD = 0.1, 0.02  # poses of one place may differ by so much where it is known well
MAX_REFINED = 12  # of the places that candidates lead to
REFINE_MARGIN_NATS = 100.0  # so far behind the likeliest a place is not refined
PRUNE_MARGIN_NATS = 250.0  # nor asked how far: it counts for as much as may speak for it
MAX_SLID, MAX_BESIDE = 8, 4  # places beside which others are looked for in a round, and how many of those
MAX_ROUNDS = 3  # until none of these is ahead


def find_places(
    known_map: KnownMap,
    seen: SeenCloud,
    guesses: Sequence[Floats] = (),
    could_win: Callable[[Aligned], bool] = lambda _: True,
    is_possible: Callable[[Floats], bool] = lambda _: True,
) -> list[Aligned]:
    """The likeliest first. Along walls that say nothing of a direction, places beside a candidate are told
    from it, too.

    guesses     poses (3,) that are candidates besides those of the search
    could_win   whether a candidate is worth to be refined; where none is they are given as they are
    is_possible whether the cloud may be at a pose (3,) at all
    """
    aligned = _distinct(_aligned(known_map, seen, is_possible))
    guessed = [known_map.align(seen, guess) for guess in guesses]
    if not any(could_win(one) for one in [*aligned, *guessed]):
        return _by_evidence([*aligned, *guessed])
    places = _refined(known_map, seen, [*aligned[:MAX_REFINED], *guessed], [])
    expanded: list[Aligned] = []
    for _ in range(MAX_ROUNDS):
        best, fresh = places[:1], [place for place in places[:MAX_SLID] if place not in expanded]
        expanded += fresh
        beside = [one for place in fresh for one in _distinct(known_map.along(seen, place))[:MAX_BESIDE]]
        places = _refined(known_map, seen, _distinct(beside), places)
        if places[:1] == best:
            break
    others = [one for one in aligned[MAX_REFINED:] if not is_same_place(one.fit.pose, places[0].fit.pose)]
    return _by_evidence(places + others)


def _aligned(known_map: KnownMap, seen: SeenCloud, is_possible: Callable[[Floats], bool]) -> list[Aligned]:
    """All candidates; of those PRUNE_MARGIN_NATS behind one before, the most that can speak for them."""
    aligned: list[Aligned] = []
    best = -math.inf
    for guess in filter(is_possible, known_map.candidates(seen.cloud)):
        aligned.append(known_map.align(seen, guess, best - PRUNE_MARGIN_NATS))
        best = max(best, aligned[-1].weight.evidence)
    return aligned


def _refined(
    known_map: KnownMap, seen: SeenCloud, aligned: list[Aligned], places: list[Aligned]
) -> list[Aligned]:
    """Places with these, refined, among them, the likeliest first."""
    for one in aligned:
        least = places[0].weight.evidence - REFINE_MARGIN_NATS if places else -math.inf
        if one.weight.evidence > least and not any(is_same_pose(one.fit.pose, p.fit.pose) for p in places):
            places = _distinct([*places, known_map.refine(seen, one)])
    return places


def is_same_place(pose: Floats, other: Floats) -> bool:
    """Whether poses (3,) are so near that one room is meant by both."""
    return bool(_are_near(pose, other, SAME_PLACE_M, SAME_PLACE_RAD))


def is_same_pose(pose: Floats, other: Floats) -> bool:
    return bool(_are_near(pose, other, SAME_POSE_M, SAME_POSE_RAD))


def _are_near(pose: Floats, others: Floats, near_m: float, near_rad: float) -> npt.NDArray[np.bool_]:
    """(...,) of others (..., 3)."""
    away = se2.between(pose, others)
    near: npt.NDArray[np.bool_] = np.hypot(away[..., 0], away[..., 1]) <= near_m
    return near & (np.abs(away[..., 2]) <= near_rad)


def _distinct(aligned: list[Aligned]) -> list[Aligned]:
    """The likeliest of each pose, the likeliest first."""
    ordered, kept = _by_evidence(aligned), []
    poses = np.array([one.fit.pose for one in ordered]).reshape(-1, 3)
    is_taken = np.zeros(len(ordered), np.bool_)
    for k, one in enumerate(ordered):
        if not is_taken[k]:
            kept.append(one)
            is_taken |= _are_near(poses[k], poses, SAME_POSE_M, SAME_POSE_RAD)
    return kept


def _by_evidence(aligned: list[Aligned]) -> list[Aligned]:
    return sorted(aligned, key=lambda one: -one.weight.evidence)
