"""Draws the graph of the default profile, for people to look at."""

from collections.abc import Collection, Sequence

import numpy as np
import numpy.typing as npt

from service.mapper.graph.graph_picture import PERIOD_NS, draw, stretches
from service.mapper.methods.corridor.graph.keyframe_list import KeyframeList
from service.mapper.methods.corridor.graph.loops import Loop
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
        found: Sequence[Loop],
        at_once: bool,
    ) -> GraphPicture | None:
        """None while the last one is fresh.

        joined    numbers of the pieces whose place is known
        found     loops of which those that are not accepted are shown as refused
        """
        if not keyframes.count:
            return None
        stamp_ns = keyframes.stamps_ns[-1]
        if not at_once and stamp_ns < self._due_ns:
            return None
        self._due_ns = stamp_ns + PERIOD_NS
        is_known = np.isin(keyframes.piece, list(joined)) & ~keyframes.is_lost
        holding = {id(loop) for loop in accepted}
        return draw(
            stamp_ns,
            keyframes.map[:, :2],
            stretches(keyframes.way_m, keyframes.piece, is_known),
            _ends(accepted),
            _ends([loop for loop in found if id(loop) not in holding]),
        )


def _ends(loops: Sequence[Loop]) -> npt.NDArray[np.int64]:
    return np.array([(loop.of, loop.to) for loop in loops], np.int64).reshape(-1, 2)
