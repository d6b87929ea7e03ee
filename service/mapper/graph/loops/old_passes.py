"""Limits the passes of a place to the first and the newest ones, which bounds memory and graph."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from service.geometry import poses as se2
from service.geometry.se2 import SE2
from service.mapper.components import Correction
from service.mapper.graph.model.keyframe_list import KeyframeList, LoopsConfig
from service.mapper.graph.model.loops import WITHIN_M, Loop

SAME_SPOT_M, SAME_VIEW_RAD = 0.5, 0.5  # key frames this close see the same
MIN_REMOVED_AT_ONCE = 200  # key frames, 60 m of path: each removal renumbers the others

Mask = npt.NDArray[np.bool_]


class Renumbering:
    """New indices if only some of N key frames are kept: number (N,), valid where is_kept (N,)."""

    def __init__(self, is_kept: Mask) -> None:
        self.is_kept = is_kept
        self.number = np.cumsum(is_kept) - 1
        self._moved: dict[int, tuple[Loop, Loop]] = {}  # by id: a loop in two lists stays one object

    def loops(self, loops: Sequence[Loop]) -> list[Loop]:
        """Loops with both ends kept, renumbered."""
        return [self._loop(loop) for loop in loops if self.is_kept[loop.of] and self.is_kept[loop.to]]

    def _loop(self, loop: Loop) -> Loop:
        if id(loop) not in self._moved:
            of, to = int(self.number[loop.of]), int(self.number[loop.to])
            self._moved[id(loop)] = loop, replace(loop, of=of, to=to)
        return self._moved[id(loop)][1]


class OldPasses:
    """Selects old passes to remove, and keeps the poses of removed key frames.

    removed_count   number of removed key frames
    """

    def __init__(self, config: LoopsConfig, keyframes: KeyframeList) -> None:
        self._config = config
        self._keyframes = keyframes
        self._checked_count = 0  # key frames checked for surplus passes
        self._to_remove: set[int] = set()  # key frames to remove
        # (G,) of the removed ones, compact, since an hour of laps makes thousands: ...
        self._gone_ns, self._begins_segment = np.zeros(0, np.int64), np.zeros(0, np.bool_)
        self._odom = np.zeros((0, 3))
        self._reference = np.zeros(0, np.int64)  # ... the nearest kept key frame of each, and ...
        self._from_reference = np.zeros((0, 3))  # ... its pose relative to that

    @property
    def removed_count(self) -> int:
        return len(self._gone_ns)

    def forget(self, loops: Sequence[Loop]) -> None:
        """Thin out the passes of places: the first one and the newest ones keep their points.

        The passes between are removed as well where a loop joins one before them to the newest. Without such
        a loop they stay in the graph, since they alone join the newest pass to the first. The first one
        stays, since otherwise each generation of passes would hand its error to the next.
        """
        config, keyframes = self._config, self._keyframes
        if not loops:
            return
        path_length_m = keyframes.path_length_m
        ends_m = path_length_m[[(loop.to, loop.of) for loop in loops]]
        to_m, of_m = ends_m[np.argsort(ends_m[:, 0], kind="stable")].T
        until = int(np.searchsorted(path_length_m, path_length_m[-1] - WITHIN_M))
        for k in range(self._checked_count, until):
            first = int(np.searchsorted(to_m, path_length_m[k] - config.place_m))
            last = int(np.searchsorted(to_m, path_length_m[k] + config.place_m, side="right"))
            if first == last:
                continue
            away = se2.between(keyframes.map[k], keyframes.map[:k])
            near = np.flatnonzero(
                (np.hypot(away[:, 0], away[:, 1]) <= SAME_SPOT_M)
                & (np.abs(away[:, 2]) <= SAME_VIEW_RAD)
                & (path_length_m[:k] < path_length_m[k] - config.apart_m)
            )
            passes = np.split(near, np.flatnonzero(np.diff(path_length_m[near]) > config.apart_m) + 1)
            is_joined = False
            for number, one in enumerate(passes[: max(len(passes) + 1 - config.keep_passes, 0)]):
                if is_joined:
                    self._to_remove.update(one.tolist())
                else:
                    apart_m = np.abs(of_m[first:last, None] - path_length_m[one])
                    is_joined = bool((apart_m <= config.place_m).any())
                if number > 0:
                    for old in one[keyframes.has_points[one]].tolist():
                        keyframes.forget(old)
        self._checked_count = max(until, self._checked_count)

    def renumbering(self, needed: Sequence[npt.ArrayLike]) -> Renumbering | None:
        """Indices after the removal of old key frames; None while they are few.

        Odometry steps pass over them, and their loops are dropped. Those of a stored map stay, and the first
        and last ones of segments.

        needed   others that stay
        """
        keyframes = self._keyframes
        if len(self._to_remove) < MIN_REMOVED_AT_ONCE:
            return None
        is_kept = np.ones(keyframes.count, np.bool_)
        is_kept[list(self._to_remove)] = False
        borders = np.flatnonzero(np.diff(keyframes.segment))
        is_kept[: max(keyframes.stored, 1)] = True
        for stays in (borders, borders + 1, *needed):
            is_kept[np.asarray(stays, np.int64)] = True
        if np.count_nonzero(~is_kept) < MIN_REMOVED_AT_ONCE:
            return None
        self._to_remove.clear()
        new = Renumbering(is_kept)
        self._remember(is_kept)
        self._reference = new.number[self._reference]
        self._checked_count = int(is_kept[: self._checked_count].sum())
        return new

    def _remember(self, is_kept: Mask) -> None:
        keyframes = self._keyframes
        gone, others = np.flatnonzero(~is_kept), np.flatnonzero(is_kept & keyframes.is_usable)
        at = keyframes.map
        nearest = [others[np.argmin(np.hypot(*(at[others, :2] - at[k, :2]).T))] for k in gone]
        beside = np.array(nearest, np.int64)
        from_beside = se2.between(at[beside], at[gone])
        again = np.flatnonzero(~is_kept[self._reference])  # their reference is removed now
        row = np.searchsorted(gone, self._reference[again])
        self._from_reference[again] = se2.compose(from_beside[row], self._from_reference[again])
        self._reference[again] = beside[row]
        self._gone_ns = np.append(self._gone_ns, np.array(keyframes.stamps_ns, np.int64)[gone])
        begins = keyframes.segment[gone] != keyframes.segment[np.maximum(gone - 1, 0)]
        self._begins_segment = np.append(self._begins_segment, begins)
        self._odom = np.vstack((self._odom, keyframes.odom[gone]))
        self._reference = np.append(self._reference, beside)
        self._from_reference = np.vstack((self._from_reference, from_beside))

    def corrections(self) -> list[Correction]:
        """Pose of each key frame of the session, by ascending stamps, including removed ones."""
        keyframes = self._keyframes
        kept = [keyframes.correction(k) for k in range(keyframes.stored, keyframes.count)]
        poses = se2.compose(keyframes.map[self._reference], self._from_reference)
        rows = zip(
            self._gone_ns.tolist(),
            self._odom.tolist(),
            poses.tolist(),
            self._begins_segment.tolist(),
            strict=True,
        )
        gone = [Correction(stamp_ns, SE2(*odom), SE2(*pose), begins) for stamp_ns, odom, pose, begins in rows]
        return sorted([*kept, *gone], key=lambda one: one.stamp_ns)
