"""Two stored graphs made one: where the second lies in the first, and all loops between them."""

from dataclasses import dataclass, replace

import numpy as np

from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.mapper.components import MapRenderer
from service.mapper.graph.loops.loop_back_end import LoopBackEnd
from service.mapper.graph.loops.loop_batches import Batch, Result
from service.mapper.graph.model.keyframe_list import SESSION_APART_M, KeyframeList
from service.mapper.graph.model.loops import Loop
from service.mapper.graph.model.loops_config import LoopsConfig
from service.mapper.graph.relocalise.detached_search import DetachedSearch
from service.mapper.saved_graph import SavedGraph

ASKED_EVERY_M = 4.0  # of the second's way
AGREE_M, AGREE_RAD = 0.5, 0.05  # two finds say the same, where both lie within AGREE_WAY_M of way
AGREE_GROWTH = 0.02  # m for each m between them: what both maps are bent by
MIN_AGREEING = 3


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
        pose_first_second, finds = _found(both, len(first), config)
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
        raise MergeError(
            "no loop holds the second map to the first where it was put; if they overlap, say how by --pair"
        )
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


def together(first: SavedGraph, second: SavedGraph) -> SavedGraph:
    """The key frames of one behind those of the other, each still in its own map frame."""

    def joined(name: str) -> np.ndarray:
        return np.concatenate((getattr(first, name), getattr(second, name)))

    names = (
        "stamp_ns odom map covariance score gap_s is_lost range_sigma_m sensor_xy_m point_count xy_base "
        "normals loop_measured loop_covariance loop_score loop_points loop_against"
    )
    way_m = second.way_m - second.way_m[0] + first.way_m[-1] + SESSION_APART_M
    piece = second.piece - second.piece.min() + first.piece.max() + 1
    return SavedGraph(
        **{name: joined(name) for name in names.split()},
        way_m=np.concatenate((first.way_m, way_m)),
        piece=np.concatenate((first.piece, piece)),
        loop_ends=np.concatenate((first.loop_ends, second.loop_ends + len(first))),
        refused=first.refused.and_also(replace(second.refused, ends=second.refused.ends + len(first))),
        by_hand=first.by_hand.and_also(second.by_hand, len(first)),
    )


def _found(both: SavedGraph, count: int, config: LoopsConfig) -> tuple[Floats, int]:
    """Pose (3,) of the second's map frame in the first's that most places say, and how many."""
    keyframes = KeyframeList(both)
    search = DetachedSearch(config, keyframes)
    usable = keyframes.is_usable
    known, own = np.flatnonzero(usable[:count]), count + np.flatnonzero(usable[count:])
    found: list[tuple[int, Floats]] = []  # key frame of the second, and the pose of its frame that it says
    asked_m = -np.inf
    for k in own.tolist():
        if keyframes.way_m[k] < asked_m + ASKED_EVERY_M:
            continue
        asked_m = float(keyframes.way_m[k])
        near = own[np.abs(keyframes.way_m[own] - keyframes.way_m[k]) <= 0.5 * config.place_m]
        best = search.best_of(search.places_of(near.tolist(), int(k), known))
        if best is not None:
            at, _ = best
            found.append((k, se2.compose(at, se2.between(keyframes.map[k], np.zeros(3)))))
    agreeing: list[tuple[int, Floats]] = []
    for k, pose in found:
        same = [
            (other, said)
            for other, said in found
            if _agree(keyframes.map[other], pose, said, abs(keyframes.way_m[k] - keyframes.way_m[other]))
        ]
        if len(same) > len(agreeing):
            agreeing = same
    if len(agreeing) < MIN_AGREEING:
        raise MergeError(
            f"{len(found)} places of the second map look like places of the first, and {len(agreeing)} of "
            f"them agree (at least {MIN_AGREEING}): the maps overlap too little; if they do, say how by "
            "--pair"
        )
    middle = agreeing[len(agreeing) // 2][1]
    return middle, len(agreeing)


def _agree(place: Floats, a: Floats, b: Floats, apart_m: float) -> bool:
    """Whether two poses of the second's frame put a place (3,) of it at the same spot."""
    away = se2.between(se2.compose(a, place), se2.compose(b, place))
    return bool(
        np.hypot(away[0], away[1]) <= AGREE_M + AGREE_GROWTH * apart_m
        and abs(away[2]) <= AGREE_RAD + 0.05 * AGREE_GROWTH * apart_m
    )
