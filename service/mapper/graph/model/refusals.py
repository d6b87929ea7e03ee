"""Refused loops, kept to explain the map to its operator."""

from collections import OrderedDict
from collections.abc import Callable, Collection, Iterable, Sequence

import numpy as np

from service.mapper.graph.model.loops import Loop
from service.mapper.refused_loops import BY_HAND, RefusedLoops

MAX_REFUSED = 1000  # the newest ones


class Refusals:
    """Refused loops by their key frames, with the latest reason."""

    def __init__(self, stored: RefusedLoops | None = None) -> None:
        self._by_ends: OrderedDict[tuple[int, int], tuple[Loop, int]] = OrderedDict()
        stored = stored or RefusedLoops()
        for k, (of, to) in enumerate(stored.ends.tolist()):
            loop = Loop(
                of,
                to,
                stored.measured[k],
                np.zeros((3, 3)),  # not used
                float(stored.score[k]),
                int(stored.points[k]),
                float(stored.against[k]),
            )
            self._by_ends[of, to] = loop, int(stored.reason[k])

    def add(self, loops: Iterable[Loop], reason: int) -> None:
        """reason: of service.mapper.refused_loops."""
        for loop in loops:
            self._by_ends.pop((loop.of, loop.to), None)
            self._by_ends[loop.of, loop.to] = loop, reason
            if len(self._by_ends) > MAX_REFUSED:
                self._by_ends.popitem(last=False)

    def renumber(self, kept: Callable[[Sequence[Loop]], list[Loop]]) -> None:
        """kept: returns those of some loops whose ends both remain, renumbered."""
        rows = [(new, reason) for loop, reason in self._by_ends.values() for new in kept([loop])]
        self._by_ends = OrderedDict(((loop.of, loop.to), (loop, reason)) for loop, reason in rows)

    def by_hand(self, accepted: Collection[Loop]) -> list[Loop]:
        """Loops that the operator removed and did not accept again."""
        ends = {(loop.of, loop.to) for loop in accepted}
        return [loop for at, (loop, why) in self._by_ends.items() if why == BY_HAND and at not in ends]

    def arrays(self, accepted: Collection[Loop]) -> RefusedLoops:
        """Loops that are not accepted."""
        accepted_ends = {(loop.of, loop.to) for loop in accepted}
        left = [one for ends, one in self._by_ends.items() if ends not in accepted_ends]
        return RefusedLoops(
            np.array([(loop.of, loop.to) for loop, _ in left], np.int64).reshape(-1, 2),
            np.array([loop.measured for loop, _ in left], np.float64).reshape(-1, 3),
            np.array([loop.share for loop, _ in left], np.float64),
            np.array([loop.points for loop, _ in left], np.int64),
            np.array([loop.against for loop, _ in left], np.float64),
            np.array([reason for _, reason in left], np.int64),
        )
