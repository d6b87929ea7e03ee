"""Search of loop closures: which earlier passes are compared with the newest key frames, and how."""

import math
from collections import OrderedDict
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.mapper.graph.loops.loop_set import LoopSet
from service.mapper.graph.model.candidate_submap import (
    MIN_LOOP_SCORE,
    REACH_SIGMAS,
    CandidateSubmap,
    cloud_of,
)
from service.mapper.graph.model.keyframe_list import KeyframeList, LoopsConfig
from service.mapper.graph.model.loops import Loop, far_from_loops, loop_of
from service.mapper.graph.model.path_drift import PathDrift, drift_from
from service.mapper.graph.model.point_clouds import Fit, PointCloud
from service.mapper.judgement import MIN_AGREEMENT_FAR
from service.mapper.loop_evidence import IN_FREE_SPACE, TOO_FAR, TOO_FEW_POINTS

LOOP_WINDOW_M, WINDOW_RAD = 0.5, 0.06  # half a search window without drift: error of a poor match
MAX_WINDOW_M, MAX_WINDOW_RAD = 12.0, 1.6  # bounds the search time
MIN_SHARE_ON_MAP = 0.45  # inlier ratio of a loop, by the drive's median: half of a place may have changed
PASSES = 4  # the nearest ones, per search
MAX_STRETCHES = 1000  # searched again at the finish, 10 s and more; of longer drives those without loops
SUBMAPS_KEPT = 16

Mask = npt.NDArray[np.bool_]


class LoopSearch:
    """Compares the newest key frames with earlier passes of their place.

    usable   returns (N,) key frames to align with
    """

    def __init__(
        self,
        config: LoopsConfig,
        keyframes: KeyframeList,
        loops: LoopSet,
        drift: PathDrift,
        usable: Callable[[], Mask],
    ) -> None:
        self._config, self._keyframes = config, keyframes
        self._loops, self._drift, self._usable = loops, drift, usable
        self.submaps = SubmapCache(config, keyframes, usable)

    def find(
        self,
        last: int,
        window: tuple[float, float] | None = None,
        before: int | None = None,
        is_across: bool = False,
    ) -> list[Loop]:
        """Loops from the query that ends at key frame `last`; those not good enough are refused.

        window      m, rad: half the search window; None: by the length of the path
        before      only at key frames before this one; None: at all
        is_across   between two sessions: no path joins them
        """
        config, keyframes, refusals = self._config, self._keyframes, self._loops.refusals
        path_length_m = keyframes.path_length_m
        first = int(np.searchsorted(path_length_m, path_length_m[last] - config.place_m))
        usable = self._usable()
        members = [k for k in range(first, last + 1) if usable[k]]
        if len(members) < 3:
            return []
        reference = members[len(members) // 2]
        reach_m, reach_rad = self._window_about(reference, window)
        away_m = np.hypot(*(keyframes.map[:, :2] - keyframes.map[reference, :2]).T)
        apart = np.abs(path_length_m - path_length_m[reference]) >= config.apart_m + config.place_m
        if window is None:
            apart &= path_length_m < path_length_m[reference]
        near = np.flatnonzero(apart & usable & (away_m <= reach_m + 1.0))
        if before is not None:
            near = near[near < before]
        cloud: PointCloud | None = None
        found = []
        for k in passes_to_search(path_length_m, near, away_m, reach_m, config.place_m):
            submap = self.submaps.about(k)
            if cloud is None:
                cloud = cloud_of(keyframes, members, reference)
            guess = se2.between(keyframes.map[submap.reference], keyframes.map[reference])
            reach = float(reach_m[k]), float(reach_rad[k])
            pose = submap.search(cloud, guess, *reach, MIN_LOOP_SCORE)
            if pose is None:
                continue
            fit = submap.align_about(cloud, pose, guess, *reach)
            is_good = self._is_good(fit)
            against = submap.against(cloud, fit.pose) if is_good else math.nan
            loop = loop_of(
                submap.reference, reference, fit.pose, fit.information, fit.share, len(cloud.xy), against
            )
            if not 1.0 - against > MIN_AGREEMENT_FAR:  # of a poor fit NaN
                refusals.add([loop], IN_FREE_SPACE if is_good else TOO_FEW_POINTS)
            elif not (is_across or self._drift.allows(loop)):
                refusals.add([loop], TOO_FAR)
            else:
                found.append(loop)
        return found

    def agrees(self, last: int, k: int) -> bool:
        """Whether key frame `last` lies on the sub-map around key frame k, where the map has it."""
        keyframes = self._keyframes
        submap = self.submaps.about(k)
        cloud = cloud_of(keyframes, [last], last)
        expected = se2.between(keyframes.map[submap.reference], keyframes.map[last])
        fit = submap.align(cloud, expected)
        is_near = math.dist(fit.pose[:2], expected[:2]) < LOOP_WINDOW_M
        return self._is_good(fit) and is_near and 1.0 - submap.against(cloud, fit.pose) > MIN_AGREEMENT_FAR

    def stretches(self) -> list[int]:
        """The last key frame of each stretch of the session to search at the finish."""
        config, keyframes = self._config, self._keyframes
        path_length_m = keyframes.path_length_m
        begin_m = config.place_m + float(path_length_m[keyframes.stored])
        at_m = np.arange(begin_m, path_length_m[-1], config.search_every_m)
        if len(at_m) > MAX_STRETCHES:
            ends = [loop.to for loop in self._loops.accepted]
            tied_m = path_length_m[ends] + 0.5 * config.place_m  # ends of the queries
            at_m = far_from_loops(at_m, tied_m, config.search_every_m)
        last: list[int] = np.unique(np.searchsorted(path_length_m, at_m)).tolist()  # some may be removed
        return last

    def _window_about(self, reference: int, window: tuple[float, float] | None) -> tuple[Floats, Floats]:
        """(N,) m and (N,) rad: half the search window at each key frame."""
        config, count = self._config, self._keyframes.count
        if window is not None:
            return np.full(count, window[0]), np.full(count, window[1])
        drift_m, drift_rad = drift_from(
            self._keyframes,
            self._loops.accepted,
            reference,
            config.keyframe_distance_m,
            (config.drift, config.drift_radpm),
        )
        reach_m = np.minimum(LOOP_WINDOW_M + REACH_SIGMAS * drift_m, MAX_WINDOW_M)
        reach_rad = np.minimum(WINDOW_RAD + REACH_SIGMAS * drift_rad, MAX_WINDOW_RAD)
        return reach_m, reach_rad

    def _is_good(self, fit: Fit) -> bool:
        return fit.share >= MIN_SHARE_ON_MAP * float(np.median(self._keyframes.score))


def passes_to_search(
    path_length_m: Floats, near: npt.NDArray[np.int64], away_m: Floats, reach_m: Floats, place_m: float
) -> list[int]:
    """The nearest key frame of each pass; where the window is wider than a sub-map, others beside it.

    path_length_m, away_m, reach_m   (N,) of all key frames: path up to each, distance, half the window, m
    near      (K,) indices of loop candidates, ascending
    place_m   half the path length of a sub-map
    """
    candidates = nearest_of_passes(path_length_m, near, away_m, place_m)[:PASSES]
    for k in list(candidates):
        aside = 1
        while aside * place_m <= reach_m[k]:
            for at_m in (path_length_m[k] - aside * place_m, path_length_m[k] + aside * place_m):
                other = int(near[np.argmin(np.abs(path_length_m[near] - at_m))])
                if abs(path_length_m[other] - at_m) < 0.5 * place_m and other not in candidates:
                    candidates.append(other)
            aside += 1
    return candidates


def nearest_of_passes(
    path_length_m: Floats, near: npt.NDArray[np.int64], away_m: Floats, place_m: float
) -> list[int]:
    """The nearest key frame of each pass, the nearest pass first; arguments as of passes_to_search."""
    if not len(near):
        return []
    breaks = np.flatnonzero(np.diff(path_length_m[near]) > place_m) + 1
    best = [int(run[np.argmin(away_m[run])]) for run in np.split(near, breaks)]
    return sorted(best, key=lambda k: (away_m[k], k))


class SubmapCache:
    """Sub-maps by key frame, least recently used first: consecutive queries search neighbouring places.

    usable   returns (N,) key frames to align with
    """

    def __init__(self, config: LoopsConfig, keyframes: KeyframeList, usable: Callable[[], Mask]) -> None:
        self._config, self._keyframes, self._usable = config, keyframes, usable
        self._submaps: OrderedDict[int, CandidateSubmap] = OrderedDict()

    def about(self, k: int) -> CandidateSubmap:
        """A sub-map around key frame k, or a cached one close by."""
        path_length_m, config = self._keyframes.path_length_m, self._config
        for reference in self._submaps:
            if abs(path_length_m[reference] - path_length_m[k]) <= config.search_every_m:
                self._submaps.move_to_end(reference)
                return self._submaps[reference]
        first = int(np.searchsorted(path_length_m, path_length_m[k] - config.place_m))
        last = int(np.searchsorted(path_length_m, path_length_m[k] + config.place_m, side="right"))
        usable = self._usable()
        members = [m for m in range(first, last) if usable[m]]
        self._submaps[k] = CandidateSubmap(self._keyframes, members, k)
        if len(self._submaps) > SUBMAPS_KEPT:
            self._submaps.popitem(last=False)
        return self._submaps[k]

    def clear(self) -> None:
        self._submaps.clear()

    def keep_before(self, first: int) -> None:
        """Drop sub-maps with key frames from `first` on, whose indices change."""
        kept = ((k, one) for k, one in self._submaps.items() if one.members[-1] < first)
        self._submaps = OrderedDict(kept)
