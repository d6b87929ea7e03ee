"""Forgets the points of old passes where newer ones see the same: time must not fill memory."""

from collections.abc import Sequence

import numpy as np

from service.geometry import poses as se2
from service.mapper.graph.model.keyframe_list import KeyframeList
from service.mapper.graph.model.loops import WITHIN_M, Loop
from service.mapper.graph.model.loops_config import LoopsConfig

SAME_SPOT_M, SAME_VIEW_RAD = 0.5, 0.5  # key frames so near see the same


class OldPasses:
    """Remembers up to where it has looked back."""

    def __init__(self, config: LoopsConfig, keyframes: KeyframeList) -> None:
        self._config = config
        self._keyframes = keyframes
        self._looked_back = 0  # key frames whose context were asked for passes too many

    def forget(self, loops: Sequence[Loop]) -> None:
        """Drop the points of the oldest pass where enough newer ones keep theirs.

        Only where loops hold the pass in its place: a drifted one would drive out another part of the map.
        """
        config, keyframes = self._config, self._keyframes
        if not loops:
            return
        way = keyframes.way_m
        looped_m = np.sort([way[loop.to] for loop in loops])
        until = int(np.searchsorted(way, way[-1] - WITHIN_M))
        for k in range(self._looked_back, until):
            right = int(np.searchsorted(looped_m, way[k] - config.place_m))
            if right == len(looped_m) or looped_m[right] > way[k] + config.place_m:
                continue
            away = se2.between(keyframes.map[k], keyframes.map[:k])
            near = np.flatnonzero(
                (np.hypot(away[:, 0], away[:, 1]) <= SAME_SPOT_M)
                & (np.abs(away[:, 2]) <= SAME_VIEW_RAD)
                & (way[:k] < way[k] - config.apart_m)
                & keyframes.has_points[:k]
            )
            passes = np.split(near, np.flatnonzero(np.diff(way[near]) > config.apart_m) + 1)
            for oldest in passes[: max(len(passes) + 1 - config.keep_passes, 0)]:
                for old in oldest.tolist():
                    keyframes.forget(old)
        self._looked_back = max(until, self._looked_back)
