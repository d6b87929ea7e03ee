"""Two stored graphs made one: where the second lies in the first, and all loops between them."""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.mapper.components import MapRenderer
from service.mapper.graph.loops.loop_back_end import LoopBackEnd
from service.mapper.graph.loops.loop_batches import Batch, Result
from service.mapper.graph.model.keyframe_list import KeyframeList
from service.mapper.graph.model.loops import Loop
from service.mapper.graph.model.loops_config import LoopsConfig
from service.mapper.graph.relocalise.detached_search import DetachedSearch
from service.mapper.saved_graph import SESSION_APART_M, SavedGraph

QUERY_EVERY_M = 4.0  # of the second's way
MERGED_WITHIN_M, MERGED_WITHIN_RAD = 0.5, 0.05  # two finds agree, both within AGREE_WAY_M of path
AGREE_GROWTH = 0.02  # m for each m between them: what both maps are bent by
MIN_MERGE_LOOPS = 3
QUERY_KEYFRAMES = 6  # key frames of a place that are looked for, where not everywhere is asked
MAX_PLACES_MISSED = 8  # far apart; where a quarter of the second overlaps, one in ten sessions has so many
SPREAD = (0, 4, 2, 6, 1, 5, 3, 7)  # every 8th place from these on, one series after the other


class MergeError(ValueError):
    """Why two graphs are not merged."""


@dataclass(frozen=True, slots=True, eq=False)
class Merged:
    """One graph of two, and what held them together."""

    result: Result  # of the last solution: saved, rendered_map, g2o
    pose_first_second: Floats  # (3,) of the second's map frame in the first's, as it was found
    finds: int  # places of the second that were found in the first and agree
    loops: list[Loop]  # between the two
    residual_m: Floats  # of each of them, after the solution
    residual_rad: Floats


def merge_graphs(
    first: SavedGraph,
    second: SavedGraph,
    renderer: MapRenderer | None,
    pose_first_second: Floats | None = None,
    config: LoopsConfig | None = None,
) -> Merged:
    """Find where the second map lies in the first, put it there, and solve both as one.

    pose_first_second   (3,) m, m, rad, if a person knows it well enough (2 m, 0.2 rad); None: it is searched

    Raises MergeError where too little of the second is found in the first.
    """
    config = config or LoopsConfig()
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
    across = [loop for loop in back_end.loops if (loop.of < len(first)) != (loop.to < len(first))]
    if not across:
        raise MergeError("no loop holds the second map to the first where it was put")
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
    """The key frames of several graphs one behind the other, each still in its own map frame."""
    graphs = (first, *others)
    before = np.cumsum([0, *(len(graph) for graph in graphs)]).tolist()
    path_length_m, segment = [first.path_length_m], [first.segment]
    refused, by_hand = first.refused, first.by_hand
    for graph, count in zip(others, before[1:], strict=False):
        path_length_m.append(
            graph.path_length_m - graph.path_length_m[0] + path_length_m[-1][-1] + SESSION_APART_M
        )
        segment.append(graph.segment - graph.segment.min() + segment[-1].max() + 1)
        refused = refused.followed_by(replace(graph.refused, ends=graph.refused.ends + count))
        by_hand = by_hand.followed_by(graph.by_hand, count)

    def joined(name: str) -> np.ndarray:
        return np.concatenate([getattr(graph, name) for graph in graphs])

    names = (
        "stamp_ns odom map covariance score gap_s is_lost range_sigma_m sensor_xy_m point_count xy_base "
        "normals loop_measured loop_covariance loop_score loop_points loop_against"
    )
    ends = [graph.loop_ends + count for graph, count in zip(graphs, before, strict=False)]
    return SavedGraph(
        **{name: joined(name) for name in names.split()},
        path_length_m=np.concatenate(path_length_m),
        segment=np.concatenate(segment),
        loop_ends=np.concatenate(ends),
        refused=refused,
        by_hand=by_hand,
    )


def find_second(
    both: SavedGraph, count: int, config: LoopsConfig, enough: int | None = None
) -> tuple[Floats, int]:
    """Pose (3,) of the second's map frame in the first's that most places say, and how many.

    count    key frames of the first, which stand before those of the second
    enough   end the search once so many places agree and no more than half as many say otherwise, or the
             first MAX_PLACES_MISSED are found nowhere; None: ask everywhere

    Raises MergeError where fewer than MIN_MERGE_LOOPS agree.
    """
    keyframes = KeyframeList(both)
    search = DetachedSearch(config, keyframes)
    usable = keyframes.is_usable
    known, own = np.flatnonzero(usable[:count]), count + np.flatnonzero(usable[count:])
    queries = _query_places(keyframes, own)
    found: list[tuple[int, Floats]] = []  # key frame of the second, and the pose of its frame that it says
    agreeing: list[tuple[int, Floats]] = []
    for number, k in enumerate(queries if enough is None else _spread(queries)):
        if enough is not None and not found and number >= MAX_PLACES_MISSED:
            break
        near = own[np.abs(keyframes.path_length_m[own] - keyframes.path_length_m[k]) <= 0.5 * config.place_m]
        near = near if enough is None else near[:: max(1, len(near) // QUERY_KEYFRAMES)]
        best = search.best_of(search.places_of(near.tolist(), k, known, only_winners=enough is not None))
        if best is None:
            continue
        at, _ = best
        found.append((k, se2.compose(at, se2.between(keyframes.map[k], np.zeros(3)))))
        if enough is not None and len(found) >= enough:
            agreeing = _agreeing(keyframes, found)
            if len(agreeing) >= enough and len(found) - len(agreeing) <= len(agreeing) // 2:
                break
    found.sort(key=lambda one: one[0])
    agreeing = _agreeing(keyframes, found)
    if len(agreeing) < MIN_MERGE_LOOPS:
        raise MergeError(
            f"{len(found)} places of the second map look like places of the first, and {len(agreeing)} of "
            f"them agree (at least {MIN_MERGE_LOOPS}): the maps overlap too little"
        )
    middle = agreeing[len(agreeing) // 2][1]
    return middle, len(agreeing)


def _query_places(keyframes: KeyframeList, own: npt.NDArray[np.int64]) -> list[int]:
    """Of some key frames by rising number one each QUERY_EVERY_M of the way."""
    queries: list[int] = []
    for k in own.tolist():
        if not queries or keyframes.path_length_m[k] >= keyframes.path_length_m[queries[-1]] + QUERY_EVERY_M:
            queries.append(k)
    return queries


def _spread(places: list[int]) -> list[int]:
    """The same in another order, in which those after each other lie far apart: every 8th, and so on."""
    return [place for first in SPREAD for place in places[first :: len(SPREAD)]]


def _agreeing(keyframes: KeyframeList, found: list[tuple[int, Floats]]) -> list[tuple[int, Floats]]:
    """The most of them that put the second at one pose."""
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
    """Whether two poses of the second's frame put a place (3,) of it at the same spot."""
    away = se2.between(se2.compose(a, place), se2.compose(b, place))
    return bool(
        np.hypot(away[0], away[1]) <= MERGED_WITHIN_M + AGREE_GROWTH * apart_m
        and abs(away[2]) <= MERGED_WITHIN_RAD + 0.05 * AGREE_GROWTH * apart_m
    )
