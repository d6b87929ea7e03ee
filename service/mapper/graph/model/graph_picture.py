"""A pose graph as a picture of bounded size, for display."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from service.geometry.poses import Floats
from service.mapper.saved_graph import SavedGraph
from service.outputs import GraphPicture

MAX_PLOTTED = 1000  # key frames, and loops of each kind; of more every second, third ... is shown
PICTURE_GAP_M = 5.0  # path without a key frame: removed ones, or another session

Ints = npt.NDArray[np.int64]


def draw(
    stamp_ns: int,
    xy_map: Floats,
    stretch: Ints,
    accepted: Ints,
    refused: Ints,
    borders: Sequence[Floats] = (),
) -> GraphPicture:
    """Picture of N key frames and the loops between them.

    xy_map     (N, 2) m, along the path
    stretch    (N,) number of the polyline that each belongs to; negative: of unknown place
    accepted   (L, 2) key frames of accepted loops
    refused    (R, 2) of refused loops
    borders    outlines of sub-maps, (K, 2) m each, map frame
    """
    xy = xy_map.astype(np.float32)
    every = -(-len(xy) // MAX_PLOTTED)
    paths = []
    for number in np.unique(stretch[stretch >= 0]).tolist():
        members = np.flatnonzero(stretch == number)
        kept = members[::every] if every else members
        paths.append(xy[kept if kept[-1] == members[-1] else np.append(kept, members[-1])])
    known = stretch >= 0
    return GraphPicture(
        stamp_ns,
        paths,
        _ends(xy, accepted, known),
        _ends(xy, refused, known),
        [border.astype(np.float32) for border in borders[-MAX_PLOTTED:]],
    )


def stretches(path_length_m: Floats, segment: Ints, is_known: npt.NDArray[np.bool_]) -> Ints:
    """(N,) polyline numbers: a new one begins with another segment, another session, and after a gap."""
    if not len(path_length_m):
        return np.empty(0, np.int64)
    begins = (
        (np.diff(segment) != 0)
        | (np.diff(path_length_m) >= PICTURE_GAP_M)
        | (np.diff(is_known.astype(int)) != 0)
    )
    numbers = np.concatenate(([0], np.cumsum(begins))).astype(np.int64)
    return np.where(is_known, numbers, -1)


def draw_saved(graph: SavedGraph) -> GraphPicture:
    """Picture of a stored graph with its accepted and refused loops."""
    stretch = stretches(graph.path_length_m, graph.segment, ~graph.is_lost)
    stamp_ns = int(graph.stamp_ns[-1]) if len(graph) else 0
    return draw(stamp_ns, graph.map[:, :2], stretch, graph.loop_ends, graph.refused.ends)


def _ends(xy: npt.NDArray[np.float32], ends: Ints, known: npt.NDArray[np.bool_]) -> npt.NDArray[np.float32]:
    ends = ends.reshape(-1, 2)
    ends = ends[known[ends].all(axis=1)]
    if len(ends) > MAX_PLOTTED:
        ends = ends[np.linspace(0, len(ends) - 1, MAX_PLOTTED).round().astype(np.int64)]
    return xy[ends]
