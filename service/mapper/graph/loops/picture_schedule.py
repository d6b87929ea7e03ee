"""When the picture of the graph is made while mapping, with figures of its loops."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from service.geometry.poses import Floats
from service.mapper.graph.model.graph_picture import draw, stretches
from service.mapper.graph.model.keyframe_list import KeyframeList
from service.mapper.graph.model.loops import Loop, Refusals, loop_arrays
from service.mapper.loop_evidence import evidence, residuals
from service.outputs import GraphPicture

PERIOD_NS = 2_000_000_000  # of the drive, between two pictures
MAX_SHOWN = 50  # loops of each kind, with their figures

Mask = npt.NDArray[np.bool_]


class PictureSchedule:
    """Makes a picture when one is due by the stamps of the key frames: the same in a replay."""

    def __init__(self) -> None:
        self._due_ns = 0

    def picture(
        self,
        keyframes: KeyframeList,
        is_known: Mask,
        accepted: Sequence[Loop],
        refusals: Refusals,
        at_once: bool,
    ) -> GraphPicture | None:
        """The picture if due, else None.

        is_known  (N,) key frames with a known place
        at_once   due in any case
        """
        if not keyframes.count:
            return None
        stamp_ns = keyframes.stamps_ns[-1]
        if not at_once and stamp_ns < self._due_ns:
            return None
        self._due_ns = stamp_ns + PERIOD_NS
        of_accepted = {name.removeprefix("loop_"): of_all for name, of_all in loop_arrays(accepted).items()}
        refused = refusals.arrays(accepted)
        of_refused = refused.by_field()
        picture = draw(
            stamp_ns,
            keyframes.map[:, :2],
            stretches(keyframes.path_length_m, keyframes.segment, is_known & ~keyframes.is_lost),
            of_accepted["ends"],
            of_refused["ends"],
        )
        off_m, _ = residuals(keyframes.map, of_accepted["ends"], of_accepted["measured"])
        open_ones = refused.chosen(np.flatnonzero(~keyframes.by_hand.pairs(refused.ends))).by_field()
        shown = {
            "accepted": _evidence(of_accepted, off_m, keyframes, is_known),
            "refused": _evidence(open_ones, open_ones["score"], keyframes, is_known),
        }
        return replace(picture, evidence=shown)


def _evidence(
    loops: Mapping[str, npt.NDArray[Any]], rank: Floats, keyframes: KeyframeList, is_known: Mask
) -> list[dict[str, Any]]:
    """Figures of the MAX_SHOWN loops with the highest rank (N,) and a known place."""
    known = np.flatnonzero(is_known[loops["ends"]].all(axis=1))
    if not len(known):
        return []
    first = known[np.argsort(-rank[known], kind="stable")][:MAX_SHOWN]
    stamps_ns = np.array(keyframes.stamps_ns, np.int64)
    shown = {name: of_all[first] for name, of_all in loops.items()}
    return evidence(shown, stamps_ns, keyframes.map, keyframes.path_length_m, int(stamps_ns[is_known].min()))
