"""Searches a cloud in a known map: candidates, each refined to the pose of highest evidence nearby."""

import math
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.kernels.beam_likelihood import MAX_LOG_RATIO
from service.mapper.graph.model.candidate_submap import SeenCloud
from service.mapper.graph.relocalise.known_map import (
    MIN_MARGIN_NATS,
    Aligned,
    KnownMap,
    rival_nats,
    winning_nats,
)

SAME_PLACE_M, SAME_PLACE_RAD = 0.5, 0.1  # poses in one room
SAME_POSE_M, SAME_POSE_RAD = 0.1, 0.02  # poses that count as equal
MAX_REFINED = 12  # places per search
REFINE_MARGIN_NATS = 100.0  # a place this far below the best is not refined
PRUNE_MARGIN_NATS = 250.0  # this far below the best, the evidence is only an upper bound
MAX_SLIDE_SOURCES, MAX_SLIDE_TARGETS = 8, 4  # places slid along walls per round, neighbours of each
MAX_ROUNDS = 3  # of sliding; ends earlier once the best place stays
EXPECTED_WINDOW = 1.5, 0.35  # m, rad: half the window about an expected pose
Window = tuple[float, float]


def find_places(
    known_map: KnownMap,
    seen: SeenCloud,
    near: Sequence[tuple[Floats, Window]] = (),
    is_anywhere: bool = True,
    must_win: bool = False,
    could_win: Callable[[Aligned], bool] = lambda _: True,
    is_possible: Callable[[Floats], bool] = lambda _: True,
) -> list[Aligned]:
    """Places of the cloud, the most likely first. Along walls that leave a direction open, neighbours of a
    candidate are evaluated, too.

    near        poses (3,) whose surroundings are searched, and half the window, m, rad
    is_anywhere whether the entire map is searched
    must_win    a place counts only if it exceeds unmapped ground by the margin
    could_win   whether a candidate is worth refining; if none is, or one of two can not win against the
                other however refined, all are returned unrefined
    is_possible whether the cloud may be at a pose (3,)
    """
    guessed = [known_map.align(seen, pose, window=window) for pose, window in near]
    aligned, least = _distinct(guessed), winning_nats(seen.mass)
    if is_anywhere:
        aligned = _distinct([*guessed, *_aligned(known_map, seen, least, is_possible)])
        if not must_win and not (aligned and aligned[0].score.evidence >= least):
            least = 0.0
            aligned = _distinct([*guessed, *_aligned(known_map, seen, least, is_possible)])
    if not any(map(could_win, aligned)) or (
        must_win and not near and _is_ambiguous(known_map, seen, aligned)
    ):
        return aligned
    places = _explored(known_map, seen, [*aligned[:MAX_REFINED], *guessed], [])
    best = places[0].score.evidence
    rival = max(rival_nats(best, seen.mass), 0.0)
    if is_anywhere and least > rival and (near or best >= least):
        aligned = _distinct(_aligned(known_map, seen, rival, is_possible))
        places = _explored(known_map, seen, aligned[:MAX_REFINED], places)
    others = [one for one in aligned[MAX_REFINED:] if not is_same_place(one.fit.pose, places[0].fit.pose)]
    return _by_evidence(places + others)


def _is_ambiguous(known_map: KnownMap, seen: SeenCloud, aligned: list[Aligned]) -> bool:
    """Whether, once refined, the best of several places can not exceed each other one by the margin."""
    best, *others = aligned
    evidence, on_walls = best.score.evidence, MAX_LOG_RATIO * seen.mass
    rival = rival_nats(max(evidence, min(evidence + REFINE_MARGIN_NATS, on_walls)), seen.mass)
    structure = known_map.structure(seen, best.fit.pose)
    return any(
        abs(structure - known_map.structure(seen, one.fit.pose)) < MIN_MARGIN_NATS
        for one in others
        if one.score.evidence >= rival and not is_same_place(one.fit.pose, best.fit.pose)
    )


def _explored(
    known_map: KnownMap, seen: SeenCloud, aligned: list[Aligned], places: list[Aligned]
) -> list[Aligned]:
    """`places` with `aligned`, refined, and their neighbours along walls, the most likely first."""
    expanded = list(places)
    places = _refined(known_map, seen, aligned, places)
    for _ in range(MAX_ROUNDS):
        best = places[0]
        least = best.score.evidence - REFINE_MARGIN_NATS
        unexpanded = [place for place in places[:MAX_SLIDE_SOURCES] if not _is_among(place, expanded)]
        expanded += unexpanded
        beside = [
            one
            for place in unexpanded
            for one in _distinct(known_map.along(seen, place, least))[:MAX_SLIDE_TARGETS]
        ]
        places = _refined(known_map, seen, _distinct(beside), places)
        if is_same_pose(places[0].fit.pose, best.fit.pose):
            break
    return places


def _aligned(
    known_map: KnownMap, seen: SeenCloud, least: float, is_possible: Callable[[Floats], bool]
) -> list[Aligned]:
    """Candidates of an evidence that may reach `least`, up to those that the best exceeds by the margin; the
    evidence of those PRUNE_MARGIN_NATS below an earlier one is an upper bound.
    """
    aligned: list[Aligned] = []
    best = -math.inf
    for *pose, bound in known_map.candidates(seen, least):
        if bound < rival_nats(best, seen.mass):
            break
        if is_possible(guess := np.array(pose)):
            aligned.append(known_map.align(seen, guess, best - PRUNE_MARGIN_NATS))
            best = max(best, aligned[-1].score.evidence)
    return aligned


def _refined(
    known_map: KnownMap, seen: SeenCloud, aligned: list[Aligned], places: list[Aligned]
) -> list[Aligned]:
    """`places` with `aligned`, refined, added, the most likely first."""
    for one in aligned:
        least = places[0].score.evidence - REFINE_MARGIN_NATS if places else -math.inf
        if one.score.evidence > least and not _is_among(one, places):
            places = _distinct([*places, known_map.refine(seen, one)])
    return places


def _is_among(one: Aligned, places: list[Aligned]) -> bool:
    return any(is_same_pose(one.fit.pose, place.fit.pose) for place in places)


def is_same_place(pose: Floats, other: Floats) -> bool:
    """Whether poses (3,) are close enough to be in one room."""
    return bool(_are_near(pose, other, SAME_PLACE_M, SAME_PLACE_RAD))


def is_same_pose(pose: Floats, other: Floats) -> bool:
    return bool(_are_near(pose, other, SAME_POSE_M, SAME_POSE_RAD))


def _are_near(pose: Floats, others: Floats, near_m: float, near_rad: float) -> npt.NDArray[np.bool_]:
    """(...,) whether others (..., 3) are near a pose."""
    away = se2.between(pose, others)
    near: npt.NDArray[np.bool_] = np.hypot(away[..., 0], away[..., 1]) <= near_m
    return near & (np.abs(away[..., 2]) <= near_rad)


def _distinct(aligned: list[Aligned]) -> list[Aligned]:
    """The most likely of each group of equal poses, the most likely first."""
    ordered, kept = _by_evidence(aligned), []
    poses = np.array([one.fit.pose for one in ordered]).reshape(-1, 3)
    is_taken = np.zeros(len(ordered), np.bool_)
    for k, one in enumerate(ordered):
        if not is_taken[k]:
            kept.append(one)
            is_taken |= _are_near(poses[k], poses, SAME_POSE_M, SAME_POSE_RAD)
    return kept


def _by_evidence(aligned: list[Aligned]) -> list[Aligned]:
    return sorted(aligned, key=lambda one: -one.score.evidence)
