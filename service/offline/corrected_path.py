"""The path of a drive in a map whose graph was corrected after it."""

import numpy as np
import numpy.typing as npt

from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.mapper.saved_graph import SavedGraph


def corrected_path(
    stamp_ns: npt.NDArray[np.int64], poses: Floats, before: SavedGraph, after: SavedGraph
) -> tuple[npt.NDArray[np.int64], Floats]:
    """(M,) and (M, 3). Each pose goes with the key frame before it; those of key frames that were cut out
    are gone.

    stamp_ns, poses   (N,) and (N, 3) of the trajectory, in the map of `before`
    """
    if not len(stamp_ns) or not len(before):
        return stamp_ns, poses
    order = np.argsort(before.stamp_ns, kind="stable")
    at = np.searchsorted(before.stamp_ns[order], stamp_ns, side="right") - 1
    held_by = order[np.maximum(at, 0)]
    # Two key frames of one moment: the first of each.
    _, row_before, row_after = np.intersect1d(before.stamp_ns, after.stamp_ns, return_indices=True)
    now = np.full(len(before), -1)
    now[row_before] = row_after
    is_left = now[held_by] >= 0
    k = held_by[is_left]
    seen = se2.between(before.map[k], poses[is_left])
    return stamp_ns[is_left], se2.compose(after.map[now[k]], seen)
