"""Replaces a part of a stored graph by a new drive; the rest stays unchanged."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from service.geometry import poses as se2
from service.geometry.polygons import Cells, is_inside
from service.geometry.poses import Floats
from service.geometry.se2 import SE2
from service.mapper.components import ScanToRender
from service.mapper.edit_requests import EditError
from service.mapper.graph.loops.stored_graph import ANCHOR_COVARIANCE
from service.mapper.graph.model.loops import Loop, loop_arrays
from service.mapper.saved_graph import SESSION_APART_M, SavedGraph

MIN_KEYFRAME_POINTS = 20  # of a key frame in the area, else it is dropped


@dataclass(frozen=True, slots=True, eq=False)
class Remapped:
    """A graph in which an area was mapped again."""

    graph: SavedGraph
    keyframes: int  # number of new ones
    points_gone: int
    points_new: int


def scans_of(session: SavedGraph, first: int) -> list[ScanToRender]:
    """Scans of the key frames from `first` on, at their poses in the map."""
    ends = np.concatenate(([0], np.cumsum(session.point_count)))
    return [
        ScanToRender(
            session.xy_base[ends[k] : ends[k + 1]],
            (float(session.sensor_xy_m[k, 0]), float(session.sensor_xy_m[k, 1])),
            SE2(*session.map[k].tolist()),
        )
        for k in range(first, len(session))
        if not session.is_lost[k]
    ]


def with_area_driven_again(
    graph: SavedGraph, session: SavedGraph, corners_map: Floats, seen: Cells, cell_m: float
) -> Remapped:
    """The graph, updated within a polygon (C, 2) m by a session that only localised in it.

    session   the key frames of `graph`, unchanged, followed by those of the session
    seen      (K, 2) row and column of the cells, of cell_m, within the polygon that the session observed

    Points of the graph in these cells are replaced; all others stay, also within the polygon. No key frame of
    the graph moves. Raises EditError if the session observed nothing of the area.
    """
    first = len(graph)
    of, xy_map = session.points()
    is_new = (of >= first) & ~session.is_lost[of] & is_inside(xy_map, corners_map)
    counts = np.bincount(of[is_new], minlength=len(session))
    kept = np.flatnonzero(counts >= MIN_KEYFRAME_POINTS)
    if not len(kept):
        raise EditError(
            "the drive saw nothing of the area: it was not found in the map there, or passed elsewhere"
        )
    is_new &= np.isin(of, kept)
    less, gone = _without_points_in(graph, seen, cell_m)
    path_length_m = (
        session.path_length_m[kept]
        - session.path_length_m[kept[0]]
        + graph.path_length_m[-1]
        + SESSION_APART_M
    )
    anchored = np.unique([kept[0], kept[-1]])
    nearest = [int(np.argmin(np.hypot(*(graph.map[:, :2] - session.map[k, :2]).T))) for k in anchored]
    between = se2.between(graph.map[nearest], session.map[anchored])
    added = first + np.searchsorted(kept, anchored)
    loops = [
        Loop(of, int(to), step, ANCHOR_COVARIANCE, 1.0)
        for of, to, step in zip(nearest, added, between, strict=True)
    ]
    new = session.of_keyframes(kept) | loop_arrays(loops)
    new |= {
        "path_length_m": path_length_m,
        "segment": np.full(len(kept), graph.segment.max() + 1),
        "point_count": counts[kept],
        "xy_base": session.xy_base[is_new],
        "normals": session.normals[is_new],
    }
    joined: dict[str, Any] = {
        name: np.concatenate((getattr(less, name), array)) for name, array in new.items()
    }
    return Remapped(
        replace(less, **joined).checked(),
        len(kept),
        gone,
        int(is_new.sum()),
    )


def _without_points_in(graph: SavedGraph, cells: Cells, cell_m: float) -> tuple[SavedGraph, int]:
    _, xy_map = graph.points()
    where = np.floor(xy_map / cell_m).astype(np.int64)
    low, high = cells.min(axis=0), cells.max(axis=0)
    is_taken = np.zeros(high - low + 1, np.bool_)
    is_taken[tuple((cells - low).T)] = True
    at = where[:, ::-1] - low  # row, column
    near = ((at >= 0) & (at < is_taken.shape)).all(axis=1)
    gone = np.zeros(len(xy_map), np.bool_)
    gone[near] = is_taken[tuple(at[near].T)]
    return graph.without_points(gone), int(gone.sum())
