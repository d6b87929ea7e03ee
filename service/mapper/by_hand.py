"""Manual edits of a map: walls, erased areas, and pairs of points that are one place."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from service.geometry import poses as se2
from service.geometry.poses import Floats

Ints = npt.NDArray[np.int64]

DRAWN_WALL, ERASED, ERASED_TO_FREE, ERASED_AS_SEEN = 0, 1, 2, 3
BECOMES = {"as_seen": ERASED_AS_SEEN, "unknown": ERASED, "free": ERASED_TO_FREE}  # of an erased area
PREFIX = "by_hand_"  # of the array names in a file


class Drawing(NamedTuple):
    """One wall or one erased area."""

    kind: int  # or ERASED (unknown), ERASED_TO_FREE, ERASED_AS_SEEN (free where beams pass, else unknown)
    until: int  # of an area: it erases the points of key frames with a lower index
    corners_map: Floats  # (C, 2) m


def _no_ints() -> Ints:
    return np.zeros(0, np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class ByHand:
    """D walls and areas with C corners in total, and P point pairs that are one place each.

    Each corner is stored in the frame of the nearest key frame, each point of a pair in that of the key
    frame that saw it. When the graph moves its key frames, the edits move with them.
    """

    kind: Ints = field(default_factory=_no_ints)  # (D,)
    until: Ints = field(default_factory=_no_ints)  # (D,)
    corner_of: Ints = field(default_factory=_no_ints)  # (C,) index of the wall or area, ascending
    corner_keyframe: Ints = field(default_factory=_no_ints)  # (C,)
    corner_xy: Floats = field(default_factory=lambda: np.zeros((0, 2)))  # (C, 2) m
    pair_ends: Ints = field(default_factory=lambda: np.zeros((0, 2), np.int64))  # (P, 2) key frames
    pair_xy: Floats = field(default_factory=lambda: np.zeros((0, 2, 2)))  # (P, 2, 2) m, in their frames

    def problem(self, keyframes: int) -> str:
        """Why the arrays do not fit a graph of so many key frames; "" if they fit."""
        drawings, corners, pairs = len(self.kind), len(self.corner_of), len(self.pair_ends)
        shapes = {
            "until": (drawings,),
            "corner_keyframe": (corners,),
            "corner_xy": (corners, 2),
            "pair_ends": (pairs, 2),
            "pair_xy": (pairs, 2, 2),
        }
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                return f"{PREFIX}{name} has the shape {getattr(self, name).shape}, expected {shape}"
        for name, most in (
            ("corner_of", drawings),
            ("corner_keyframe", keyframes),
            ("pair_ends", keyframes),
            ("until", keyframes + 1),
        ):
            index = getattr(self, name)
            if len(index) and (index.min() < 0 or index.max() >= most):
                return f"{PREFIX}{name} has an index outside 0..{most - 1}"
        if not (np.isfinite(self.corner_xy).all() and np.isfinite(self.pair_xy).all()):
            return f"{PREFIX}corner_xy or {PREFIX}pair_xy is not finite"
        return ""

    def pairs(self, ends: Ints) -> npt.NDArray[np.bool_]:
        """(N,) whether a point pair joins the key frames `ends`, (N, 2)."""
        joined = {(of, to) for of, to in self.pair_ends.tolist()}
        return np.array([(of, to) in joined for of, to in ends.tolist()], np.bool_)

    def drawings(self, map_poses: Floats) -> list[Drawing]:
        """Walls and areas in the map, with the key frames at map_poses, (N, 3)."""
        xy = se2.points_from(map_poses[self.corner_keyframe], self.corner_xy)
        return [
            Drawing(kind, until, xy[self.corner_of == k])
            for k, (kind, until) in enumerate(zip(self.kind.tolist(), self.until.tolist(), strict=True))
        ]

    def with_drawing(self, drawing: Drawing, map_poses: Floats) -> "ByHand":
        """A copy with one more wall or area. map_poses: (N, 3) of the key frames; one at NaN is not used."""
        corners = drawing.corners_map
        keyframe = np.array([_nearest(map_poses, xy) for xy in corners], np.int64)
        return replace(
            self,
            kind=np.append(self.kind, drawing.kind),
            until=np.append(self.until, drawing.until),
            corner_of=np.append(self.corner_of, np.full(len(corners), len(self.kind))),
            corner_keyframe=np.append(self.corner_keyframe, keyframe),
            corner_xy=np.vstack((self.corner_xy, se2.points_seen(map_poses[keyframe], corners))),
        )

    def with_point_pair(self, ends: tuple[int, int], xy: Floats) -> "ByHand":
        """A copy with one more pair: point xy[0] seen from key frame ends[0] and xy[1] from ends[1], (2,) m
        each.
        """
        return replace(
            self,
            pair_ends=np.vstack((self.pair_ends, np.array(ends, np.int64))),
            pair_xy=np.concatenate((self.pair_xy, xy[None])),
        )

    def without_pairs(self, gone: Sequence[int]) -> "ByHand":
        kept = np.setdiff1d(np.arange(len(self.pair_ends)), gone)
        return replace(self, pair_ends=self.pair_ends[kept], pair_xy=self.pair_xy[kept])

    def without_keyframes(self, is_kept: npt.NDArray[np.bool_], map_poses: Floats) -> "ByHand":
        """A copy for the kept key frames: corners move to the nearest of them, pairs that lost an end are
        dropped.
        """
        number = np.cumsum(is_kept) - 1
        left = map_poses[is_kept]
        before = np.concatenate(([0], np.cumsum(is_kept)))
        remade = replace(ByHand(), pair_ends=number[self.pair_ends], pair_xy=self.pair_xy).without_pairs(
            np.flatnonzero(~is_kept[self.pair_ends].all(axis=1)).tolist()
        )
        for drawing in self.drawings(map_poses):
            remade = remade.with_drawing(drawing._replace(until=int(before[drawing.until])), left)
        return remade

    def followed_by(self, other: "ByHand", keyframes: int) -> "ByHand":
        """These edits of the first `keyframes` key frames, and `other` of those after them."""
        moved = replace(
            other,
            until=other.until + keyframes,
            corner_of=other.corner_of + len(self.kind),
            corner_keyframe=other.corner_keyframe + keyframes,
            pair_ends=other.pair_ends + keyframes,
        )
        return ByHand(
            *(np.concatenate((getattr(self, f.name), getattr(moved, f.name))) for f in fields(self))
        )

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        return {PREFIX + f.name: getattr(self, f.name) for f in fields(self)}

    @staticmethod
    def from_arrays(arrays: Mapping[str, npt.NDArray[Any]]) -> "ByHand":
        """Inverse of `arrays`. Raises KeyError."""
        return ByHand(**{f.name: arrays[PREFIX + f.name] for f in fields(ByHand)})


def _nearest(map_poses: Floats, xy: Floats) -> int:
    return int(np.nanargmin(np.hypot(map_poses[:, 0] - xy[0], map_poses[:, 1] - xy[1])))


def pairs_of(by_hand: ByHand, map_poses: Floats) -> list[dict[str, Any]]:
    """Point pairs and their remaining distance with the key frames at map_poses, (N, 3), for JSON."""
    ends = by_hand.pair_ends
    xy = se2.points_from(map_poses[ends], by_hand.pair_xy)
    apart_m = np.hypot(*(xy[:, 0] - xy[:, 1]).T)
    return [
        {
            "pair": k,
            "keyframes": ends[k].tolist(),
            "x_m": round(float(xy[k, 0, 0]), 2),
            "y_m": round(float(xy[k, 0, 1]), 2),
            "other_x_m": round(float(xy[k, 1, 0]), 2),
            "other_y_m": round(float(xy[k, 1, 1]), 2),
            "apart_mm": round(1e3 * float(apart_m[k]), 1),
        }
        for k in range(len(ends))
    ]
