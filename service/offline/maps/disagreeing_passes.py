"""Pairs of passes of one place that a stored map draws beside each other, for a person to join or to leave.

The graph has aligned them already: these are loops that were measured, that fit, and that were not accepted.
"""

from typing import Any, NamedTuple

import numpy as np

from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.mapper.graph.loops.loop_back_end import AGREE_M, AGREE_RAD
from service.mapper.graph.model.loops import WITHIN_M
from service.mapper.refused_loops import CONTRADICTED, NOT_SUPPORTED, TOO_FAR, WORDS
from service.mapper.saved_graph import SavedGraph

MAX_PROPOSED = 20
POINTS = 3  # of a proposal: two fix place and heading, the third shows whether they do
COUNTERPART_M = 0.1  # from a point of the later pass to one that the earlier key frame saw
_FITS = (NOT_SUPPORTED, CONTRADICTED, TOO_FAR)  # reasons that leave the alignment itself in no doubt


class _Spot(NamedTuple):
    """of, to   key frames; measured: (3,) `to` seen from `of`; apart_m, apart_rad: the map says otherwise"""

    of: int
    to: int
    measured: Floats
    share: float
    reason: int
    apart_m: float
    apart_rad: float


def disagreeing_passes(graph: SavedGraph) -> list[dict[str, Any]]:
    """One for each two stretches of the way, that with the best fit first.

    keyframes     the earlier and the later one
    points        (POINTS, 2, 2) m, map frame: a point of the earlier pass, and where the later one draws it
    x_m, y_m      of the later key frame; apart_m, apart_deg: between the map and the alignment
    on_map        share of the points of the later pass that lie on the earlier one
    """
    way = graph.way_m
    proposed: list[_Spot] = []
    told: list[dict[str, Any]] = []
    for spot in sorted(_spots(graph), key=lambda spot: -spot.share):
        is_new = all(
            max(abs(way[spot.of] - way[one.of]), abs(way[spot.to] - way[one.to])) > WITHIN_M
            for one in proposed
        )
        if is_new and len(points := _points(graph, spot)) and len(told) < MAX_PROPOSED:
            proposed.append(spot)
            told.append(_reported(graph, spot, points))
    return told


def _spots(graph: SavedGraph) -> list[_Spot]:
    """Of all that disagree with the map by more than two loops that say the same."""
    refused = graph.refused
    off = se2.between(
        refused.measured, se2.between(graph.map[refused.ends[:, 0]], graph.map[refused.ends[:, 1]])
    )
    apart_m, apart_rad = np.hypot(off[:, 0], off[:, 1]), np.abs(off[:, 2])
    disagrees = ((apart_m > AGREE_M) | (apart_rad > AGREE_RAD)) & np.isin(refused.reason, _FITS)
    return [
        _Spot(
            int(refused.ends[k, 0]),
            int(refused.ends[k, 1]),
            refused.measured[k],
            float(refused.score[k]),
            int(refused.reason[k]),
            float(apart_m[k]),
            float(apart_rad[k]),
        )
        for k in np.flatnonzero(disagrees).tolist()
    ]


def _points(graph: SavedGraph, spot: _Spot) -> Floats:
    """(POINTS, 2, 2) m far from each other, of what both saw where that is enough; without points none."""
    earlier, later = (_seen(graph, k) for k in (spot.of, spot.to))
    if not len(earlier) or not len(later):
        return np.zeros((0, 2, 2))
    of_earlier = se2.points_from(spot.measured, later)
    away_m = np.array([np.hypot(*(earlier - xy).T).min() for xy in of_earlier])
    common = np.flatnonzero(away_m < COUNTERPART_M)
    left = common if len(common) >= POINTS else np.arange(len(later))
    nearest_m = np.hypot(*(of_earlier[left] - of_earlier[left].mean(axis=0)).T)  # to a point chosen before
    chosen: list[int] = []
    for _ in range(min(POINTS, len(left))):
        best = int(nearest_m.argmax())
        away_m = np.hypot(*(of_earlier[left] - of_earlier[left[best]]).T)
        nearest_m = np.minimum(nearest_m, away_m) if chosen else away_m
        chosen.append(int(left[best]))
    ends = (se2.points_from(graph.map[spot.of], of_earlier), se2.points_from(graph.map[spot.to], later))
    return np.stack([end[chosen] for end in ends], axis=1)


def _seen(graph: SavedGraph, k: int) -> Floats:
    first = int(graph.point_count[:k].sum())
    return graph.xy_base[first : first + int(graph.point_count[k])].astype(np.float64)


def _reported(graph: SavedGraph, spot: _Spot, points: Floats) -> dict[str, Any]:
    return {
        "keyframes": [spot.of, spot.to],
        "points": np.round(points, 4).tolist(),
        "x_m": round(float(graph.map[spot.to, 0]), 2),
        "y_m": round(float(graph.map[spot.to, 1]), 2),
        "apart_m": round(spot.apart_m, 3),
        "apart_deg": round(float(np.degrees(spot.apart_rad)), 2),
        "on_map": round(spot.share, 3),
        "why": WORDS[spot.reason],
    }
