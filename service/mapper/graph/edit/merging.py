"""Merges two stored graphs: finds the place of the second in the first, and the loops between them."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.mapper.components import MapRenderer
from service.mapper.graph.loops.loop_back_end import Batch, LoopBackEnd, Result
from service.mapper.graph.model.keyframe_list import KeyframeList, LoopsConfig
from service.mapper.graph.model.loops import Loop
from service.mapper.graph.relocalise.detached_search import CandidatePose, DetachedSearch
from service.mapper.graph.relocalise.known_map import KnownMap
from service.mapper.graph.relocalise.place_search import SAME_PLACE_M, is_same_place, is_same_pose
from service.mapper.saved_graph import KEYFRAME_ROWS, LOOP_ROWS, SESSION_APART_M, SavedGraph

QUERY_EVERY_M = 4.0  # of path in the second graph; loops every 2 m add nothing on intel
MERGE_AGREE_RAD = 0.05  # two results within SAME_PLACE_M and this agree, plus AGREE_GROWTH
AGREE_GROWTH = 0.02  # m per m of path between them: distortion of both maps
MIN_MERGE_LOOPS = 3
QUERY_KEYFRAMES = 6  # key frames of a query, where the search may end early
MAX_PLACES_MISSED = 8  # far apart; of sessions that overlap by a quarter, one in ten has so many
MAX_RIVALS = 3  # of a result: other rooms that fit, whose map poses are tested at the next queries, too
SPREAD = (0, 4, 2, 6, 1, 5, 3, 7)  # offsets of the series of every 8th place


class MergeError(ValueError):
    """Two graphs cannot be merged; the message gives the reason."""


@dataclass(frozen=True, slots=True, eq=False)
class Merged:
    """The merged graph, and the loops between its two parts."""

    result: Result  # of the last optimisation: saved, rendered_map, g2o
    pose_first_second: Floats  # (3,) second map frame in the first, by the search
    finds: int  # number of places of the second that were found in the first and agree
    loops: list[Loop]  # between the two
    residual_m: Floats  # of each loop, after optimisation
    residual_rad: Floats


def merge_graphs(
    first: SavedGraph,
    second: SavedGraph,
    renderer: MapRenderer | None,
    pose_first_second: Floats | None = None,
) -> Merged:
    """Find the place of the second map in the first, and optimise both as one graph.

    pose_first_second   (3,) m, m, rad, if known within 2 m and 0.2 rad; None: it is searched

    Raises MergeError if too few places of the second are found in the first.
    """
    config = LoopsConfig()
    both = together(first, second)
    finds = 0
    if pose_first_second is None:
        pose_first_second, finds = find_second(both, len(first), config)
    here = np.arange(len(both)) >= len(first)
    placed = both.map.copy()
    placed[here] = se2.compose(pose_first_second, both.map[here])
    back_end = LoopBackEnd(config, renderer, replace(both, map=placed))
    back_end.begin_session_at(len(first))
    result: Result = back_end.work(Batch([], is_last=True))
    saved = result.saved
    assert isinstance(saved, SavedGraph)
    across = [loop for loop in back_end.loops.accepted if (loop.of < len(first)) != (loop.to < len(first))]
    if not across:
        raise MergeError("no loop joins the second map to the first at the pose given or found")
    off = [se2.between(loop.measured, se2.between(saved.map[loop.of], saved.map[loop.to])) for loop in across]
    residual = np.array(off)
    return Merged(
        result,
        pose_first_second,
        finds,
        across,
        np.hypot(residual[:, 0], residual[:, 1]),
        np.abs(residual[:, 2]),
    )


def together(first: SavedGraph, *others: SavedGraph) -> SavedGraph:
    """The key frames of several graphs in sequence, each still in its own map frame."""
    graphs = (first, *others)
    before = np.cumsum([0, *(len(graph) for graph in graphs)]).tolist()
    path_length_m, segment = [first.path_length_m], [first.segment]
    ends, refused, by_hand = [first.loop_ends], first.refused, first.by_hand
    for graph, count in zip(others, before[1:], strict=False):
        path_length_m.append(
            graph.path_length_m - graph.path_length_m[0] + path_length_m[-1][-1] + SESSION_APART_M
        )
        segment.append(graph.segment - graph.segment.min() + segment[-1].max() + 1)
        ends.append(graph.loop_ends + count)
        refused = refused.followed_by(replace(graph.refused, ends=graph.refused.ends + count))
        by_hand = by_hand.followed_by(graph.by_hand, count)
    names = (*KEYFRAME_ROWS, *LOOP_ROWS, "xy_base", "normals")
    parts = {name: [getattr(graph, name) for graph in graphs] for name in names}
    parts |= {"path_length_m": path_length_m, "segment": segment, "loop_ends": ends}
    return SavedGraph(
        **{name: np.concatenate(arrays) for name, arrays in parts.items()}, refused=refused, by_hand=by_hand
    )


def find_second(
    both: SavedGraph,
    count: int,
    config: LoopsConfig,
    enough: int | None = None,
    known_map: KnownMap | None = None,
) -> tuple[Floats, int]:
    """Pose (3,) of the second map frame in the first by most query results, and their number.

    count       number of key frames of the first, which precede those of the second
    enough      end the search when so many results agree and at most half as many disagree, or when the
                first MAX_PLACES_MISSED queries fail; None: query every place. After a result the next queries
                search only near the poses that follow from it and its rivals; MAX_PLACES_MISSED that fail
                there are repeated on the entire map
    known_map   of the usable key frames of the first, if there is one; None: it is built

    Raises MergeError if fewer than MIN_MERGE_LOOPS agree.
    """
    keyframes = KeyframeList(both)
    search = DetachedSearch(config, keyframes, known_map)
    usable = keyframes.is_usable
    known, own = np.flatnonzero(usable[:count]), count + np.flatnonzero(usable[count:])
    queries = _query_places(keyframes, own)
    found: list[tuple[int, Floats]] = []  # key frame of the second, and the pose of its frame by that query
    agreeing: list[tuple[int, Floats]] = []
    waiting = deque(queries if enough is None else _spread(queries))
    frames: list[Floats] = []  # poses of the second map frame by the last result and its rivals
    missed: list[int] = []  # queries without a result near these
    while waiting and (enough is None or found or len(queries) - len(waiting) < MAX_PLACES_MISSED):
        k = waiting.popleft()
        near = own[np.abs(keyframes.path_length_m[own] - keyframes.path_length_m[k]) <= 0.5 * config.place_m]
        near = near if enough is None else near[:: max(1, len(near) // QUERY_KEYFRAMES)]
        expected = [se2.compose(frame, keyframes.map[k]) for frame in frames]
        places = search.places_of(near.tolist(), k, known, expected=expected)
        best = search.best_of(places)
        if best is not None:
            at, _ = best
            found.append((k, _frame_of(keyframes, k, at)))
            agreeing = _agreeing(keyframes, found)
            if enough is not None and not frames:
                frames = [_frame_of(keyframes, k, place.pose) for place in _with_rivals(places, at)]
            if enough is not None and len(agreeing) >= enough and len(found) <= 1.5 * len(agreeing):
                break
        elif frames:
            missed.append(k)
        if len(missed) >= MAX_PLACES_MISSED or (not waiting and len(agreeing) < MIN_MERGE_LOOPS):
            waiting.extend(missed)
            frames, missed = [], []
    found.sort(key=lambda one: one[0])
    agreeing = _agreeing(keyframes, found)
    if len(agreeing) < MIN_MERGE_LOOPS:
        raise MergeError(
            f"{len(found)} places of the second map look like places of the first, and {len(agreeing)} of "
            f"them agree (at least {MIN_MERGE_LOOPS}): the maps overlap too little"
        )
    middle = agreeing[len(agreeing) // 2][1]
    return middle, len(agreeing)


def _frame_of(keyframes: KeyframeList, k: int, pose: Floats) -> Floats:
    """Pose (3,) of the second map frame in the first, from the pose of its key frame k."""
    frame: Floats = se2.compose(pose, se2.between(keyframes.map[k], np.zeros(3)))
    return frame


def _with_rivals(places: Sequence[CandidatePose], best: Floats) -> list[CandidatePose]:
    """The best place and the most likely ones in other rooms that fit, MAX_RIVALS at most."""
    chosen = [place for place in places if is_same_pose(place.pose, best)][:1]
    for place in sorted(places, key=lambda place: -place.evidence):
        is_other = not any(is_same_place(place.pose, other.pose) for other in chosen)
        if len(chosen) <= MAX_RIVALS and place.loop is not None and is_other:
            chosen.append(place)
    return chosen


def _query_places(keyframes: KeyframeList, own: npt.NDArray[np.int64]) -> list[int]:
    """Every QUERY_EVERY_M of path one of some key frames, ascending."""
    queries: list[int] = []
    for k in own.tolist():
        if not queries or keyframes.path_length_m[k] >= keyframes.path_length_m[queries[-1]] + QUERY_EVERY_M:
            queries.append(k)
    return queries


def _spread(places: list[int]) -> list[int]:
    """The places in an order in which consecutive ones are far apart: series of every 8th."""
    return [place for first in SPREAD for place in places[first :: len(SPREAD)]]


def _agreeing(keyframes: KeyframeList, found: list[tuple[int, Floats]]) -> list[tuple[int, Floats]]:
    """The largest set of results that agree on one pose."""
    agreeing: list[tuple[int, Floats]] = []
    for k, pose in found:
        same = [
            (other, other_pose)
            for other, other_pose in found
            if _agree(
                keyframes.map[other],
                pose,
                other_pose,
                abs(keyframes.path_length_m[k] - keyframes.path_length_m[other]),
            )
        ]
        if len(same) > len(agreeing):
            agreeing = same
    return agreeing


def _agree(place: Floats, a: Floats, b: Floats, apart_m: float) -> bool:
    """Whether two poses of the second frame agree at a place (3,) of it."""
    away = se2.between(se2.compose(a, place), se2.compose(b, place))
    return bool(
        np.hypot(away[0], away[1]) <= SAME_PLACE_M + AGREE_GROWTH * apart_m
        and abs(away[2]) <= MERGE_AGREE_RAD + 0.05 * AGREE_GROWTH * apart_m
    )
