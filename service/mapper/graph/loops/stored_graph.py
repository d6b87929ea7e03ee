"""Stored graphs: conversion of the back end's state, and a session on a fixed stored map."""

from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt

from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.geometry.se2 import SE2
from service.mapper.components import Placed, ScanToRender, ToRender
from service.mapper.drawn_by_hand import among_scans
from service.mapper.graph.model.keyframe_list import STORED, KeyframeList
from service.mapper.graph.model.loops import Loop, Refusals, as_edges, loop_arrays
from service.mapper.graph.model.pose_graph import Edges, PoseGraph, Sightings
from service.mapper.graph.relocalise.detached_search import MIN_APART_M
from service.mapper.saved_graph import SavedGraph

MAX_CONTRADICTIONS = 2  # consecutive failed verifications
# m^2, rad^2: of each point of a manual pair, and of the first remaining key frame by removed loops
ANCHOR_COVARIANCE = np.diag([0.02**2, 0.02**2, 0.005**2])


def saved_graph(
    keyframes: KeyframeList,
    loops: Sequence[Loop],
    is_known: npt.NDArray[np.bool_],
    refusals: Refusals,
) -> SavedGraph:
    """Some key frames, (N,), and the loops between them."""
    by_hand = keyframes.by_hand
    if not is_known.all():
        by_hand = by_hand.without_keyframes(is_known, keyframes.map)
    kept = np.flatnonzero(is_known)
    number = np.cumsum(is_known) - 1
    between = [loop for loop in loops if is_known[loop.of] and is_known[loop.to]]
    of_loops = loop_arrays(between)
    of_loops["loop_ends"] = number[of_loops["loop_ends"]]
    thinned = [keyframes.thinned[k] for k in kept.tolist()]
    return SavedGraph(
        stamp_ns=np.array(keyframes.stamps_ns, np.int64)[kept],
        segment=keyframes.segment[kept],
        **{name: getattr(keyframes, name)[kept] for name in STORED},
        sensor_xy_m=np.array([one.sensor_xy_m for one in thinned], np.float64).reshape(-1, 2),
        point_count=np.array([len(one.xy_base) for one in thinned], np.int64),
        xy_base=np.concatenate([np.zeros((0, 2), np.float32), *(one.xy_base for one in thinned)]),
        normals=np.concatenate([np.zeros((0, 3), np.float32), *(one.normals for one in thinned)]),
        **of_loops,
        refused=refusals.arrays(loops).renumbered(number, is_known),
        by_hand=by_hand,
    )


def to_render(keyframes: KeyframeList, among: npt.NDArray[np.bool_]) -> Iterator[ToRender]:
    """Scans of some key frames (N,), if they were matched, and manual edits."""
    known = np.flatnonzero(among & ~keyframes.is_lost)
    scans = (
        (
            k,
            ScanToRender(
                keyframes.thinned[k].xy_base,
                keyframes.thinned[k].sensor_xy_m,
                SE2(*keyframes.map[k].tolist()),
            ),
        )
        for k in known.tolist()
    )
    return among_scans(scans, keyframes.by_hand, keyframes.map)


def landmarks_of_pairs(keyframes: KeyframeList) -> tuple[Floats, Sightings]:
    """(P, 2) m: landmarks in the map for manual point pairs; and the points as seen by the key frames."""
    ends, xy = keyframes.by_hand.pair_ends, keyframes.by_hand.pair_xy
    count = len(ends)
    if not count:
        return np.empty((0, 2)), Sightings.none()
    sightings = Sightings(
        ends.ravel(),
        np.repeat(np.arange(count), 2),
        xy.reshape(-1, 2),
        np.tile(ANCHOR_COVARIANCE[:2, :2], (2 * count, 1, 1)),
        np.zeros(2 * count),
    )
    return se2.points_from(keyframes.map[ends], xy).mean(axis=1), sightings


def graph_on_fixed(
    keyframes: KeyframeList, odometry: Edges, loops: Sequence[Loop], fixed_count: int
) -> PoseGraph:
    """Graph of the key frames from fixed_count on, after one pose for the fixed ones before.

    A loop to a fixed key frame becomes an edge from that pose.
    """
    own = (odometry.of >= fixed_count) & (odometry.to >= fixed_count)
    seen = as_edges([loop for loop in loops if loop.to >= fixed_count])
    is_fixed = seen.of < fixed_count
    measured = seen.measured.copy()
    measured[is_fixed] = se2.compose(keyframes.map[seen.of[is_fixed]], seen.measured[is_fixed])
    edges = Edges(
        odometry.of[own] - fixed_count + 1,
        odometry.to[own] - fixed_count + 1,
        odometry.measured[own],
        odometry.covariance[own],
        odometry.kernel_width[own],
    ).followed_by(
        Edges(
            np.where(is_fixed, 0, seen.of - fixed_count + 1),
            seen.to - fixed_count + 1,
            measured,
            seen.covariance,
            seen.kernel_width,
        )
    )
    poses = np.vstack((np.zeros(3), keyframes.map[fixed_count:]))
    return PoseGraph(poses, edges)


def anchor_loop(keyframes: KeyframeList, k: int) -> Loop:
    """A loop that keeps key frame k at its pose in the map, in place of removed ones."""
    return Loop(0, k, se2.between(keyframes.map[0], keyframes.map[k]), ANCHOR_COVARIANCE, 1.0)


class Placement:
    """Confidence of a session's place in the stored map.

    A place is found from one viewpoint, and rooms may look alike. It is confirmed by scans from MIN_APART_M
    on, and revoked if they contradict it.
    """

    def __init__(self, is_in_stored: bool) -> None:
        self.state: Placed = "unknown" if is_in_stored else "proven"
        self._found_m = 0.0  # path length at which it was found
        self._contradictions = 0

    def found(self, path_length_m: float) -> None:
        if self.state == "unknown":
            self.state, self._found_m, self._contradictions = "unproven", path_length_m, 0

    def seen(self, path_length_m: float, agrees: bool) -> bool:
        """Take a verification at a path length on known ground; whether the place must be revoked."""
        if self.state != "unproven":
            return False
        if agrees and path_length_m - self._found_m >= MIN_APART_M:
            self.state = "proven"
        self._contradictions = 0 if agrees else self._contradictions + 1
        if self._contradictions < MAX_CONTRADICTIONS:
            return False
        self.state = "unknown"
        return True
