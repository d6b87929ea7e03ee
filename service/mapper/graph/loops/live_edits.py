"""Manual changes of a map while it is being made, applied to the key frames of the back end."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from drivers.counted import counted
from service.geometry import poses as se2
from service.geometry.groups import groups_of
from service.geometry.polygons import is_inside
from service.geometry.poses import Floats
from service.mapper.by_hand import BECOMES, DRAWN_WALL, ByHand, Drawing, pairs_of
from service.mapper.components import EditAnswer
from service.mapper.edit_requests import (
    AcceptSeenLoop,
    AddPairs,
    Cut,
    EditError,
    Erase,
    LiveChange,
    Optimize,
    RefuseSeenLoop,
    RemovePair,
    SeenLoop,
    SeenPair,
    Undo,
    Wall,
    erased_words,
    moved_words,
    wall_words,
)
from service.mapper.graph.loops.old_passes import Renumbering
from service.mapper.graph.model.keyframe_list import KeyframeList, ThinnedScan
from service.mapper.graph.model.loops import Loop, Refusals
from service.mapper.loop_evidence import BY_HAND, points_of

MAX_UNDONE = 50  # changes kept for undo
WALL_MARGIN_M = 0.2  # margin of the rendered area around a wall

Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class AppliedEdit:
    """An applied change, and what undo restores.

    words     description
    is_bent   the graph is to be solved
    about     (C, 2) m in the map: the area to render again; None: all
    points    removed ones, by key frame
    matched   key frames that were set to lost
    """

    words: str
    by_hand: ByHand
    is_bent: bool = True
    about: Floats | None = None
    points: Mapping[int, ThinnedScan] = field(default_factory=dict)
    matched: Sequence[int] = ()
    loops: Sequence[Loop] = ()


class LiveEdits:
    """Applies changes, and undoes them, the newest first. Does not optimise the graph."""

    def __init__(self, keyframes: KeyframeList, refusals: Refusals) -> None:
        self._keyframes = keyframes
        self._refusals = refusals
        self._applied: list[AppliedEdit] = []

    def make(
        self, change: LiveChange, is_known: Mask, loops: Sequence[Loop]
    ) -> tuple[AppliedEdit, list[Loop]]:
        """Apply a change; returns it and the remaining loops.

        is_known (N,): key frames with a known place in the map. Raises EditError.
        """
        if not is_known.any():
            raise EditError("there is nothing in the map yet; it begins with the first scan that is mapped")
        before = self._keyframes.by_hand
        if isinstance(change, Undo):
            applied = self._undo()
            return applied, [*loops, *applied.loops]
        if isinstance(change, Optimize):
            return AppliedEdit("optimised", before), [*loops]
        match change:
            case Erase():
                applied = self._erase(np.array(change.corners), BECOMES[change.becomes], is_known, before)
            case Wall():
                line = np.array(change.corners)
                self._draw(Drawing(DRAWN_WALL, 0, line), is_known)
                applied = AppliedEdit(wall_words(line), before, False, _around(line))
            case Cut():
                applied = self._cut(change, is_known, before, loops)
            case AddPairs():
                applied = self._pair(change.pairs, is_known, before)
            case RefuseSeenLoop():
                applied = self._refuse(change, is_known, before, loops)
            case AcceptSeenLoop():
                applied = self._accept(change, is_known, before, loops)
            case RemovePair():
                applied = self._remove_pair(change.pair, before)
        self._applied = [*self._applied, applied][-MAX_UNDONE:]
        return applied, [loop for loop in loops if not any(loop is gone for gone in applied.loops)]

    def renumber(self, new: Renumbering) -> None:
        """Update the undo list before only some key frames are kept."""
        is_kept, number = new.is_kept, new.number
        self._applied = [
            replace(
                applied,
                by_hand=applied.by_hand.without_keyframes(is_kept, self._keyframes.map),
                points={int(number[k]): points for k, points in applied.points.items() if is_kept[k]},
                matched=[int(number[k]) for k in applied.matched if is_kept[k]],
                loops=new.loops(applied.loops),
            )
            for applied in self._applied
        ]

    def answer(
        self, applied: AppliedEdit, is_known: Mask, before: Floats, contradicted: int = 0
    ) -> EditAnswer:
        """The reply to a change. before: (N, 3) earlier key-frame poses; contradicted: loops that the gate
        dropped.
        """
        keyframes = self._keyframes
        moved_m = float(np.hypot(*(keyframes.map - before)[is_known, :2].T).max())
        words = moved_words(applied.words, moved_m, contradicted) if applied.is_bent else applied.words
        pairs = pairs_of(keyframes.by_hand, keyframes.map)
        return EditAnswer(
            {"done": words, "moved_m": round(moved_m, 3), "pairs": pairs, "undoable": len(self._applied)}
        )

    def _undo(self) -> AppliedEdit:
        if not self._applied:
            raise EditError("no change of this session is left to take back")
        applied, keyframes = self._applied.pop(), self._keyframes
        keyframes.by_hand = applied.by_hand
        for k, points in applied.points.items():
            keyframes.put_points(k, points)
        keyframes.set_lost(applied.matched, False)
        return replace(applied, words=f"took back: {applied.words}")

    def _erase(self, corners: Floats, kind: int, is_known: Mask, before: ByHand) -> AppliedEdit:
        keyframes = self._keyframes
        taken: dict[int, ThinnedScan] = {}
        count = 0
        for k in np.flatnonzero(keyframes_near(keyframes, corners, is_known)).tolist():
            points = keyframes.thinned[k]
            gone = is_inside(se2.points_from(keyframes.map[k], points.xy_base.astype(np.float64)), corners)
            if gone.any():
                taken[k] = points
                left = ThinnedScan(points.xy_base[~gone], points.normals[~gone], points.sensor_xy_m)
                keyframes.put_points(k, left)
                count += int(gone.sum())
        self._draw(Drawing(kind, keyframes.count, corners), is_known)
        words = f"{erased_words(corners)}: {counted(count, 'point')} gone"
        return AppliedEdit(words, before, False, corners, taken)

    def _draw(self, drawing: Drawing, is_known: Mask) -> None:
        known = np.where(is_known[:, None], self._keyframes.map, np.nan)
        self._keyframes.by_hand = self._keyframes.by_hand.with_drawing(drawing, known)

    def _cut(self, change: Cut, is_known: Mask, before: ByHand, loops: Sequence[Loop]) -> AppliedEdit:
        """Remove points, loops and pairs of key frames. Their poses stay, since odometry passes over them:
        with its covariance if bridged, else as unmeasured steps.
        """
        keyframes = self._keyframes
        stamps_ns = np.array(keyframes.stamps_ns, np.int64)
        after_s = (stamps_ns - stamps_ns[is_known].min()) / 1e9
        is_cut = is_known & (after_s >= change.from_s) & (after_s <= change.to_s)
        if not is_cut.any():
            raise EditError("no key frame lies in that time")
        if is_cut[is_known].all():
            raise EditError("that is all of the map: nothing would be left")
        points = {k: keyframes.thinned[k] for k in np.flatnonzero(is_cut).tolist()}
        for k in points:
            keyframes.forget(k)
        matched = [] if change.bridge else [k for k in points if not keyframes.is_lost[k]]
        keyframes.set_lost(matched, True)
        gone = [loop for loop in loops if is_cut[loop.of] or is_cut[loop.to]]
        pairs = np.flatnonzero(is_cut[before.pair_ends].any(axis=1))
        keyframes.by_hand = before.without_pairs(pairs.tolist())
        words = f"cut {counted(len(points), 'key frame')} out, and {counted(len(gone), 'loop')} with them"
        return AppliedEdit(words, before, points=points, matched=matched, loops=gone)

    def _pair(self, pairs: Sequence[SeenPair], is_known: Mask, before: ByHand) -> AppliedEdit:
        by_hand, number = before, len(before.pair_ends)
        for pair in pairs:
            first, second = self._ends(pair, is_known)
            if first == second:
                raise EditError("both points of a pair are of one key frame; a pair is of two")
            by_hand = by_hand.with_point_pair((first, second), np.array(pair.points_base))
        self._keyframes.by_hand = by_hand
        last = number + len(pairs) - 1
        named = f"pair {number}" if len(pairs) == 1 else f"pairs {number} to {last}"
        return AppliedEdit(named, before)

    def _refuse(self, change: SeenLoop, is_known: Mask, before: ByHand, loops: Sequence[Loop]) -> AppliedEdit:
        of, to = self._ends(change, is_known)
        gone = [loop for loop in loops if (loop.of, loop.to) == (of, to)]
        if not gone:
            raise EditError(f"no accepted loop joins the key frames {of} and {to} any more")
        segments, segment = np.unique(self._keyframes.segment, return_inverse=True)
        left = [(loop.of, loop.to) for loop in loops if loop not in gone] + before.pair_ends.tolist()
        group = groups_of(len(segments), segment[np.array(left, np.int64)])
        if group[segment[of]] != group[segment[to]]:
            raise EditError(
                "only this loop joins a part of the map that was begun after the vehicle was lost; "
                "join it by a pair of points first, or cut it out"
            )
        self._refusals.add(gone, BY_HAND)
        return AppliedEdit(f"took back the loop from key frame {to} to {of}", before, loops=gone)

    def _accept(self, change: SeenLoop, is_known: Mask, before: ByHand, loops: Sequence[Loop]) -> AppliedEdit:
        """Accept a refused loop as two equivalent point pairs."""
        of, to = self._ends(change, is_known)
        refused = self._refusals.arrays(loops)
        found = np.flatnonzero((refused.ends == (of, to)).all(axis=1))
        if not len(found) or before.pairs(np.array([(of, to)])).any():
            raise EditError(f"no refused loop joins the key frames {of} and {to} any more")
        by_hand = before
        for seen in points_of(refused.measured[found[0]]):
            by_hand = by_hand.with_point_pair((of, to), seen)
        self._keyframes.by_hand = by_hand
        number = len(before.pair_ends)
        return AppliedEdit(
            f"accepted the loop from key frame {to} to {of} as pairs {number}, {number + 1}", before
        )

    def _ends(self, change: SeenLoop | SeenPair, is_known: Mask) -> tuple[int, int]:
        of, to = (self._keyframe(int(stamp), is_known) for stamp in change.stamps_ns)
        return of, to

    def _keyframe(self, stamp_ns: int, is_known: Mask) -> int:
        found = np.flatnonzero((np.array(self._keyframes.stamps_ns, np.int64) == stamp_ns) & is_known)
        if len(found) != 1:
            raise EditError(
                f"the key frame of {stamp_ns} ns is not in the map any more; fetch the key frames again"
            )
        return int(found[0])

    def _remove_pair(self, number: int, before: ByHand) -> AppliedEdit:
        if number >= (count := len(before.pair_ends)):
            raise EditError(f"there is no pair {number}; the map has {count}, numbered from 0")
        self._keyframes.by_hand = before.without_pairs([number])
        return AppliedEdit(f"removed pair {number}", before)


def keyframes_near(keyframes: KeyframeList, corners_map: Floats, among: Mask) -> Mask:
    """(N,) the key frames, of some, that may see a part of a polygon (C, 2) m of the map."""
    low, high = corners_map.min(axis=0), corners_map.max(axis=0)
    near = np.flatnonzero(among)
    away_m = np.hypot(*(keyframes.map[near, :2] - 0.5 * (low + high)).T)
    sees_m = np.array([_reach_m(keyframes.thinned[k]) for k in near.tolist()])
    is_near = np.zeros(keyframes.count, np.bool_)
    is_near[near] = away_m <= sees_m + 0.5 * float(np.hypot(*(high - low)))
    return is_near


def _reach_m(scan: ThinnedScan) -> float:
    return math.sqrt(float((scan.xy_base.astype(np.float64) ** 2).sum(axis=1).max(initial=0.0)))


def _around(line: Floats) -> Floats:
    """(4, 2) m: the bounding box of a line (C, 2), with a margin."""
    (left, low), (right, high) = line.min(axis=0) - WALL_MARGIN_M, line.max(axis=0) + WALL_MARGIN_M
    return np.array([(left, low), (right, low), (right, high), (left, high)])
