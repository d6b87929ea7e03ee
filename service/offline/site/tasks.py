"""What is done of a site in parallel: where a session lies in it, and the loops between two sessions."""

import threading
from bisect import bisect_right
from dataclasses import dataclass, replace
from itertools import accumulate
from pathlib import Path

import numpy as np

from service.mapper.graph.edit.merging import (
    MIN_MERGE_LOOPS,
    QUERY_EVERY_M,
    MergeError,
    find_second,
    together,
)
from service.mapper.graph.loops.loop_back_end import LoopBackEnd
from service.mapper.graph.model.keyframe_list import KeyframeList, LoopsConfig
from service.mapper.graph.model.loops import Loop
from service.mapper.graph.relocalise.known_map import KnownMap
from service.mapper.saved_graph import SavedGraph, from_arrays, packed_points, small_arrays
from service.mapstore.arrays import read_arrays, write_arrays
from service.offline.cluster.tasks import Done


class _Searched(threading.local):
    """The map of the site that this thread searched last: of all sessions of a round it is the same, and what
    it costs to build grows with the site.
    """

    sites: tuple[Path, ...] = ()
    known_map: KnownMap | None = None

    def map_of(self, sites: tuple[Path, ...], both: SavedGraph, count: int) -> KnownMap:
        """Of the first `count` key frames, which the files `sites` hold."""
        if self.known_map is None or self.sites != sites:
            keyframes = KeyframeList(both)
            self.known_map = KnownMap(keyframes, np.flatnonzero(keyframes.is_usable[:count]))
            self.sites = sites
        return self.known_map


_searched = _Searched()


@dataclass(frozen=True, slots=True)
class _OfSession:
    """sites, session   files that keep_graph wrote: parts of the site, and what is searched in them"""

    name: str
    sites: tuple[Path, ...]
    session: Path
    program: str

    def graphs(self) -> tuple[SavedGraph, list[int]]:
        """All in one; and the number of the first key frame of each, the session last. Raises InputError."""
        files = [read_arrays(path) for path in (*self.sites, self.session)]
        graphs = [from_arrays(arrays, [arrays]) for arrays in files]
        return together(*graphs), [0, *accumulate(map(len, graphs[:-1]))]


class Find(_OfSession):
    """Search of a session in the site: outcome `pose_first_second` [x m, y m, theta rad], or `why` it is
    not found.
    """

    def work(self) -> Done:
        try:
            both, begins = self.graphs()
            known_map = _searched.map_of(self.sites, both, begins[-1])
            pose, _ = find_second(both, begins[-1], LoopsConfig(), MIN_MERGE_LOOPS, known_map)
        except MergeError as error:
            return Done({"why": str(error)}, {})
        return Done({"pose_first_second": pose.tolist()}, {})


class FindLoops(_OfSession):
    """Loops from other sessions to one, accepted as in the mapper: outcome `loops`, a list for each of the
    others, their key frames counted in either graph. The session lies within 1.5 m and 0.2 rad of its pose in
    the frame of the others. Only the graph of all sessions tells which loops the rest contradicts: here the
    loops between the others are missing, so one of these may be bent.
    """

    def work(self) -> Done:
        _searched.known_map = None  # 0.2 GB of a large site, which loops are searched without
        whole, begins = self.graphs()
        back_end = LoopBackEnd(LoopsConfig(search_every_m=QUERY_EVERY_M), None, whole)
        back_end.begin_session_at(begins[-1], is_across=True)
        back_end.search_again()
        loops: list[list[Loop]] = [[] for _ in self.sites]
        for loop in back_end.loops.accepted:
            of = bisect_right(begins, loop.of) - 1
            if of < len(self.sites) and loop.to >= begins[-1]:
                loops[of].append(replace(loop, of=loop.of - begins[of], to=loop.to - begins[-1]))
        return Done({"loops": loops}, {})


def keep_graph(graph: SavedGraph, path: Path) -> Path:
    """Write a graph to a new file, for tasks. Raises OSError."""
    with path.open("xb") as file:
        write_arrays(file, small_arrays(graph) | packed_points(graph, 0, len(graph)), level=0)
    return path
