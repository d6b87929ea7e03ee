"""Pairs of passes of one place that a stored map has at different poses, for a person to join.

The graph has aligned them already: these are loops that were measured, that fit, and that were not accepted.
"""

from typing import Any

import numpy as np

from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.mapper.graph.loops.loop_set import AGREE_M, AGREE_RAD
from service.mapper.graph.model.loops import WITHIN_M
from service.mapper.loop_evidence import CONTRADICTED, NOT_SUPPORTED, TOO_FAR, WORDS, residuals
from service.mapper.saved_graph import SavedGraph

MAX_PROPOSED = 20
POINTS = 3  # of a proposal: two fix place and heading, the third shows whether they do
COUNTERPART_M = 0.1  # from a point of the later pass to one that the earlier key frame saw
_FITS = (NOT_SUPPORTED, CONTRADICTED, TOO_FAR)  # reasons that do not question the alignment itself


def disagreeing_passes(graph: SavedGraph) -> list[dict[str, Any]]:
    """One for each two stretches of the path that disagree with the map by more than two loops that measure
    the same; that with the best fit first.

    keyframes     the earlier and the later one
    points        (POINTS, 2, 2) m, map frame: a point of the earlier pass, and where the later one draws it
    x_m, y_m      of the later key frame; apart_m, apart_deg: between the map and the alignment
    on_map        share of the points of the later pass that lie on the earlier one
    """
    refused, end_m = graph.refused, graph.path_length_m[graph.refused.ends]
    apart_m, apart_rad = residuals(graph.map, refused.ends, refused.measured)
    disagrees = ((apart_m > AGREE_M) | (apart_rad > AGREE_RAD)) & np.isin(refused.reason, _FITS)
    proposed: list[int] = []
    reported: list[dict[str, Any]] = []
    for k in np.argsort(-refused.score, kind="stable").tolist():
        if not disagrees[k] or (np.abs(end_m[proposed] - end_m[k]).max(axis=1) <= WITHIN_M).any():
            continue
        earlier, later = refused.ends[k].tolist()
        if not len(points := _points(graph, earlier, later, refused.measured[k])):
            continue
        proposed.append(k)
        reported.append(
            {
                "keyframes": [earlier, later],
                "points": np.round(points, 4).tolist(),
                "x_m": round(float(graph.map[later, 0]), 2),
                "y_m": round(float(graph.map[later, 1]), 2),
                "apart_m": round(float(apart_m[k]), 3),
                "apart_deg": round(float(np.degrees(apart_rad[k])), 2),
                "on_map": round(float(refused.score[k]), 3),
                "why": WORDS[refused.reason[k]],
            }
        )
        if len(reported) == MAX_PROPOSED:
            break
    return reported


def _points(graph: SavedGraph, of: int, to: int, measured: Floats) -> Floats:
    """(POINTS, 2, 2) m far from each other, of what both saw where that is enough; without points none.

    measured    (3,) pose of key frame `to` in the frame of `of`
    """
    earlier, later = graph.points_of(of), graph.points_of(to)
    if not len(earlier) or not len(later):
        return np.zeros((0, 2, 2))
    of_earlier = se2.points_from(measured, later)
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
    ends = (se2.points_from(graph.map[of], of_earlier), se2.points_from(graph.map[to], later))
    return np.stack([end[chosen] for end in ends], axis=1)
