"""Manual changes of a stored graph. Each function returns a new graph; only `solved` optimises it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from drivers.counted import counted
from service.geometry import poses as se2
from service.geometry.groups import groups_of
from service.geometry.polygons import is_inside
from service.geometry.poses import Floats
from service.mapper.by_hand import BECOMES, DRAWN_WALL, Drawing
from service.mapper.components import MapRenderer, RenderedMap
from service.mapper.edit_requests import Becomes, EditError
from service.mapper.graph.gnss.anchoring import Anchoring
from service.mapper.graph.loops.loop_back_end import LoopBackEnd
from service.mapper.graph.model.keyframe_list import LoopsConfig
from service.mapper.graph.model.pose_graph import PoseGraph
from service.mapper.loop_evidence import BY_HAND, RefusedLoops
from service.mapper.saved_graph import SavedGraph

SEEN_WITHIN_M = 0.3  # from a given point to a point of the key frame that saw it
SAME_PASS_M = 10.0  # path length: two points within it are of one pass


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """A graph after optimisation."""

    graph: SavedGraph
    rendered_map: RenderedMap
    contradicted: int  # number of loops removed by the chi-square gate
    moved_m: Floats  # (N,) of each key frame


def with_wall(graph: SavedGraph, corners_map: Floats) -> SavedGraph:
    """The graph with a wall along the polyline (C, 2) m of the map, C > 1."""
    return replace(graph, by_hand=graph.by_hand.with_drawing(Drawing(DRAWN_WALL, 0, corners_map), graph.map))


def with_area_erased(
    graph: SavedGraph, corners_map: Floats, becomes: Becomes = "as_seen"
) -> tuple[SavedGraph, int]:
    """The graph without the points within a polygon (C, 2) m of the map, and the number of these points.
    Later key frames may fill the area again.
    """
    _, xy_map = graph.points()
    gone = is_inside(xy_map, corners_map)
    drawing = Drawing(BECOMES[becomes], len(graph), corners_map)
    by_hand = graph.by_hand.with_drawing(drawing, graph.map)
    return replace(graph.without_points(gone), by_hand=by_hand), int(gone.sum())


def without_time(graph: SavedGraph, from_ns: int, to_ns: int, is_bridged: bool) -> SavedGraph:
    """The graph without the key frames stamped from_ns to to_ns, both included.

    is_bridged   odometry over the cut connects its two ends; else only loops and pairs do

    Raises EditError if no key frame or every key frame lies there, or if the graph would be disconnected.
    """
    is_kept = (graph.stamp_ns < from_ns) | (graph.stamp_ns > to_ns)
    if is_kept.all():
        raise EditError("no key frame lies in that time; map info tells from when to when each session lasts")
    if not is_kept.any():
        raise EditError("that is all of the map: nothing would be left")
    segment = graph.segment if is_bridged else _segments_after_cut(graph.segment, is_kept)
    remaining = only(replace(graph, segment=segment), is_kept)
    bridge = "--bridge connects them by odometry over the cut"
    _refuse_if_disconnected(groups(graph)[is_kept], remaining, bridge, int(graph.stamp_ns.min()))
    return remaining


def only(graph: SavedGraph, is_kept: npt.NDArray[np.bool_]) -> SavedGraph:
    """The graph of some key frames, (N,), with the loops and edits between them."""
    number = np.cumsum(is_kept) - 1
    loops_kept = is_kept[graph.loop_ends].all(axis=1)
    loops = graph.of_loops(loops_kept)
    loops["loop_ends"] = number[loops["loop_ends"]]
    count = graph.point_count[is_kept]
    before = (np.cumsum(graph.point_count) - graph.point_count)[is_kept] - (np.cumsum(count) - count)
    points_kept = np.repeat(before, count) + np.arange(count.sum())  # a member of a site has few of them
    return replace(
        graph,
        **graph.of_keyframes(is_kept),
        xy_base=graph.xy_base[points_kept],
        normals=graph.normals[points_kept],
        **loops,
        refused=graph.refused.renumbered(number, is_kept),
        by_hand=graph.by_hand.without_keyframes(is_kept, graph.map),
    )


def with_pair(graph: SavedGraph, xy_map: Floats, keyframes: Sequence[int] | None = None) -> SavedGraph:
    """The graph with two points (2, 2) m of the map marked as one place.

    keyframes   the two that saw them; None: for the first point the key frame with the nearest point, for the
                second that of another pass

    Raises EditError if no key frame saw a point, or one saw both.
    """
    if keyframes is None:
        first = _observing_keyframe(graph, xy_map[0], np.ones(len(graph), np.bool_), "the first point")
        elsewhere = (np.abs(graph.path_length_m - graph.path_length_m[first]) > SAME_PASS_M) | (
            graph.segment != graph.segment[first]
        )
        keyframes = (
            first,
            _observing_keyframe(graph, xy_map[1], elsewhere, "the second point, in another pass,"),
        )
    first, second = keyframes
    for k in (first, second):
        if not 0 <= k < len(graph):
            raise EditError(f"there is no key frame {k}; they are numbered from 0 to {len(graph) - 1}")
    if first == second:
        raise EditError(f"both points are of key frame {first}: a pair is of two key frames")
    seen = se2.points_seen(graph.map[[first, second]], xy_map)
    return replace(graph, by_hand=graph.by_hand.with_point_pair((first, second), seen))


def without_pair(graph: SavedGraph, number: int) -> SavedGraph:
    """The graph without a pair. Raises EditError for an unknown pair, or if the graph would fall apart."""
    count = len(graph.by_hand.pair_ends)
    if not 0 <= number < count:
        raise EditError(f"there is no pair {number}; {_counted(count, 'pair')}")
    remaining = replace(graph, by_hand=graph.by_hand.without_pairs([number]))
    _refuse_if_disconnected(groups(graph), remaining, "cut one of them away first")
    return remaining


def without_loops(graph: SavedGraph, numbers: Sequence[int]) -> SavedGraph:
    """The graph without some loops. Raises EditError for an unknown loop, or if the graph would be
    disconnected.
    """
    count = len(graph.loop_ends)
    if unknown := [number for number in numbers if not 0 <= number < count]:
        raise EditError(f"there is no accepted loop {unknown[0]}; {_counted(count, 'loop')}")
    kept = np.setdiff1d(np.arange(count), numbers)
    remaining = replace(
        graph,
        **graph.of_loops(kept),
        refused=graph.refused.followed_by(_refused(graph, numbers)),
    )
    _refuse_if_disconnected(
        groups(graph), remaining, "--add-pair connects them, or cut one of them away first"
    )
    return remaining


def solved(graph: SavedGraph, renderer: MapRenderer) -> Solved:
    """The graph optimised with odometry, loops and pairs, and rendered; the first key frame stays fixed."""
    saved = optimised(graph)
    rendered_map = LoopBackEnd(LoopsConfig(), renderer, saved).render()
    assert rendered_map is not None
    off = saved.map[:, :2] - graph.map[:, :2]
    return Solved(saved, rendered_map, len(graph.loop_ends) - len(saved.loop_ends), np.hypot(*off.T))


def optimised(graph: SavedGraph, anchoring: Anchoring | None = None) -> SavedGraph:
    """The graph optimised with odometry, loops, pairs and fixes, without the loops that fail the chi-square
    gate; the first key frame stays fixed.
    """
    back_end = LoopBackEnd(LoopsConfig(), None, graph, anchoring=anchoring)
    is_anchored = anchoring is not None and anchoring.reference is not None
    if is_anchored or len(graph.loop_ends) or len(graph.by_hand.pair_ends):
        back_end.solve()
    return back_end.saved()


def rendered_part(graph: SavedGraph, corners_map: Floats, renderer: MapRenderer) -> RenderedMap:
    """The graph rendered within a polygon (C, 2) m of the map."""
    rendered = LoopBackEnd(LoopsConfig(), renderer, graph).render(corners_map)
    assert rendered is not None
    return rendered


def graph_of(graph: SavedGraph) -> PoseGraph:
    """Pose graph of a stored graph at its poses: odometry, loops, and pairs as landmarks."""
    return LoopBackEnd(LoopsConfig(), None, graph).graph()


def groups(graph: SavedGraph) -> npt.NDArray[np.int64]:
    """(N,) connected component of each key frame by odometry, loops and pairs: its lowest key frame."""
    joined = [graph.loop_ends, graph.by_hand.pair_ends]
    for segment in np.unique(graph.segment):
        own = np.flatnonzero(graph.segment == segment)
        joined.append(np.column_stack((own[:-1], own[1:])))
    return groups_of(len(graph), np.concatenate(joined))


def _refused(graph: SavedGraph, numbers: Sequence[int]) -> RefusedLoops:
    which = np.unique(np.array(numbers, np.int64))
    return RefusedLoops.of(graph.of_loops(which), np.full(len(which), BY_HAND))


def _segments_after_cut(
    segment: npt.NDArray[np.int64], is_kept: npt.NDArray[np.bool_]
) -> npt.NDArray[np.int64]:
    """Segment numbers after a cut: the parts that it leaves of a segment become segments of their own."""
    cut = segment.copy()
    number = int(segment.max()) + 1
    for one in np.unique(segment):
        own = np.flatnonzero(segment == one)
        here = is_kept[own]
        run = np.cumsum(here & ~np.append(False, here[:-1]))  # 1 for the first part kept, 2 for the next ...
        later = here & (run > 1)
        cut[own[later]] = number + run[later] - 2
        number += max(int(run[-1]) - 1, 0)
    return cut


def _refuse_if_disconnected(
    before: npt.NDArray[np.int64], graph: SavedGraph, instead: str, first_ns: int | None = None
) -> None:
    """Raises EditError if key frames of one component before, (N,), are disconnected now.

    first_ns   origin of the times in the message; None: that of the first key frame
    """
    first_ns = int(graph.stamp_ns.min()) if first_ns is None else first_ns
    after = groups(graph)
    for group in np.unique(before):
        parts = np.unique(after[before == group])
        if len(parts) > 1:
            named = "; ".join(_named(graph, np.flatnonzero(after == part), first_ns) for part in parts)
            raise EditError(f"{len(parts)} parts of the map would be disconnected: {named}. {instead}")


def _named(graph: SavedGraph, own: npt.NDArray[np.int64], first_ns: int) -> str:
    (left, low), (right, high) = graph.map[own, :2].min(axis=0), graph.map[own, :2].max(axis=0)
    return (
        f"{counted(len(own), 'key frame')} between ({left:.1f}, {low:.1f}) and ({right:.1f}, {high:.1f}) m "
        f"from {(int(graph.stamp_ns[own[0]]) - first_ns) / 1e9:.2f} s on"
    )


def _observing_keyframe(graph: SavedGraph, xy_map: Floats, among: npt.NDArray[np.bool_], what: str) -> int:
    """Of some key frames the one with the point nearest to a point of the map; of equals the nearest one."""
    of, seen_map = graph.points()
    away_m = np.where(among[of], np.hypot(*(seen_map - xy_map).T), np.inf)
    if not len(away_m) or away_m.min() > SEEN_WITHIN_M:
        raise EditError(
            f"{what} at ({xy_map[0]:.2f}, {xy_map[1]:.2f}) m was seen by no key frame within "
            f"{SEEN_WITHIN_M} m; point at a wall of the map, or name two key frames by --keyframes"
        )
    near = np.unique(of[away_m <= max(2.0 * float(away_m.min()), 0.02)])
    return int(near[np.argmin(np.hypot(*(graph.map[near, :2] - xy_map).T))])


def _counted(count: int, what: str) -> str:
    if not count:
        return f"there is no {what} at all"
    return f"the map has {count}, numbered from 0"
