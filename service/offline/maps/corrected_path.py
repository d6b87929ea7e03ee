"""The path of a drive in a map whose graph was corrected after it."""

import numpy as np
import numpy.typing as npt

from service.geometry.poses import Floats
from service.mapper.corrections import bent
from service.mapper.saved_graph import SavedGraph


def corrected_path(
    stamp_ns: npt.NDArray[np.int64], poses: Floats, before: SavedGraph, after: SavedGraph
) -> tuple[npt.NDArray[np.int64], Floats]:
    """(M,) and (M, 3): the path bent to where the key frames are now, as a replay bends it. The poses that
    followed a key frame which was cut out are gone.

    stamp_ns, poses   (N,) and (N, 3) of the trajectory, in the map of `before`
    """
    if not len(stamp_ns) or not len(before):
        return stamp_ns, poses
    # Two key frames of one moment: the last of each, for those of a map that the drive began in stand first.
    at_ns, from_end = np.unique(before.stamp_ns[::-1], return_index=True)
    row = len(before) - 1 - from_end
    _, kept, from_end = np.intersect1d(at_ns, after.stamp_ns[::-1], return_indices=True)
    now = np.full(len(at_ns), -1)
    now[kept] = len(after) - 1 - from_end
    is_kept = now >= 0
    at = np.maximum(np.searchsorted(at_ns, stamp_ns, side="right") - 1, 0)
    is_left = is_kept[at]
    at, stamp_ns = at[is_left], stamp_ns[is_left]
    # What is left before a cut goes with the key frame before it alone.
    ends_at_cut = ~is_kept[np.minimum(at + 1, len(at_ns) - 1)]
    weighed_ns = np.where(ends_at_cut, at_ns[at], stamp_ns)
    moved = bent(
        weighed_ns, poses[is_left], at_ns[is_kept], before.map[row[is_kept]], after.map[now[is_kept]]
    )
    return stamp_ns, moved
