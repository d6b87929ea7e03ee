"""Draws the graph of the default profile, for people to look at."""

from collections.abc import Collection, Sequence

import numpy as np

from service.mapper.graph.model.graph_picture import PERIOD_NS, draw, stretches
from service.mapper.graph.model.keyframe_list import KeyframeList
from service.mapper.graph.model.loops import Loop
from service.mapper.graph.model.refusals import Refusals
from service.outputs import GraphPicture


class Drawing:
    """A picture when one is due, by the stamps of the key frames: a replay has the same ones."""

    def __init__(self) -> None:
        self._due_ns = 0

    def picture(
        self,
        keyframes: KeyframeList,
        joined: Collection[int],
        accepted: Sequence[Loop],
        refusals: Refusals,
        at_once: bool,
    ) -> GraphPicture | None:
        """None while the last one is fresh.

        joined    numbers of the pieces whose place is known
        at_once   however fresh the last one is
        """
        if not keyframes.count:
            return None
        stamp_ns = keyframes.stamps_ns[-1]
        if not at_once and stamp_ns < self._due_ns:
            return None
        self._due_ns = stamp_ns + PERIOD_NS
        is_known = np.isin(keyframes.piece, list(joined)) & ~keyframes.is_lost
        return draw(
            stamp_ns,
            keyframes.map[:, :2],
            stretches(keyframes.way_m, keyframes.piece, is_known),
            np.array([(loop.of, loop.to) for loop in accepted], np.int64).reshape(-1, 2),
            refusals.arrays(accepted).ends,
        )
