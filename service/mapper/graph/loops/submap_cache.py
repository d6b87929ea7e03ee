"""Cache of the sub-maps used in loop searches: consecutive queries search neighbouring places."""

from collections import OrderedDict
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from service.mapper.graph.model.candidate_submap import CandidateSubmap
from service.mapper.graph.model.keyframe_list import KeyframeList
from service.mapper.graph.model.loops_config import LoopsConfig

SUBMAPS_KEPT = 16


class SubmapCache:
    """Sub-maps by key frame, least recently used first.

    usable   returns (N,) key frames to align with
    """

    def __init__(
        self, config: LoopsConfig, keyframes: KeyframeList, usable: Callable[[], npt.NDArray[np.bool_]]
    ) -> None:
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
