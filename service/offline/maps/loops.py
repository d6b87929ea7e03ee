"""`corridor map loops`: which loops hold a stored map together, which were not accepted, and why."""

from pathlib import Path
from typing import Any

import numpy as np

from service.errors import InputError
from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.mapper.by_hand import pairs_of
from service.mapper.refused_loops import WORDS
from service.mapper.saved_graph import SavedGraph
from service.mapstore.files import load_map

PAIR_M = 5.0  # far enough to fix the turn, too


def map_loops(folder: Path, version: int | None = None) -> dict[str, Any]:
    """The loops of a version (None: the current one), for JSON: accepted ones first, as `map edit
    --refuse-loop` numbers them.

    Raises InputError where no map can be read, or where it holds no graph.
    """
    stored = load_map(folder, version)
    graph = stored.graph
    if graph is None:
        raise InputError(f"{folder}: this map holds what was shown, not what it was made of: it has no loops")
    accepted, refused = loops_of(graph)
    return {
        "map": str(folder),
        "version": stored.number,
        "accepted": accepted,
        "refused": refused,
        "pairs": pairs_of(graph.by_hand, graph.map),
        "problems": stored.problems,
    }


def loops_of(graph: SavedGraph) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Those that hold it together, and those that were measured and are not accepted."""
    refused = graph.refused
    accepted = _reported(
        graph, graph.loop_ends, graph.loop_measured, graph.loop_score, graph.loop_points, graph.loop_against
    )
    not_accepted = _reported(
        graph, refused.ends, refused.measured, refused.score, refused.points, refused.against
    )
    return (
        [{"loop": k, **facts} for k, facts in enumerate(accepted)],
        [
            {"why": WORDS[reason], **facts}
            for reason, facts in zip(refused.reason.tolist(), not_accepted, strict=True)
        ],
    )


def residuals(graph: SavedGraph, ends: np.ndarray, measured: Floats) -> tuple[Floats, Floats]:
    """(N,) m and (N,) rad between what loops measured, (N, 3), and the map; ends: (N, 2) key frames."""
    off = se2.between(measured, se2.between(graph.map[ends[:, 0]], graph.map[ends[:, 1]]))
    return np.hypot(off[:, 0], off[:, 1]), np.abs(off[:, 2])


def as_pairs(graph: SavedGraph, ends: np.ndarray, measured: Floats) -> list[list[list[list[float]]]]:
    """Of each loop two pairs of points of the map, (2, 2, 2) m, that say together what it measured: both lie
    `PAIR_M` from the second key frame, seen as they would be from there and from the first.
    """
    seen = np.array([[PAIR_M, 0.0], [-PAIR_M, 0.0]])
    pairs = []
    for (of, to), second in zip(ends.tolist(), measured, strict=True):
        first_xy = se2.points_from(graph.map[of], se2.points_from(second, seen))
        second_xy = se2.points_from(graph.map[to], seen)
        pairs.append(np.stack((first_xy, second_xy), axis=1).round(5).tolist())
    return pairs


def loops_table(loops: dict[str, Any]) -> list[list[str]]:
    """Rows of words, heads first."""
    heads = ["loop", "at x m", "y m", "from s", "back at s"]
    heads += ["points", "on map", "in free", "off mm", "off deg"]
    rows = [[*heads, "why not"]]
    for loop in loops["accepted"]:
        rows.append([str(loop["loop"]), *_cells(loop), ""])
    for loop in loops["refused"]:
        rows.append(["refused", *_cells(loop), loop["why"]])
    return rows


def _cells(loop: dict[str, Any]) -> list[str]:
    def share(value: float | None) -> str:
        return "-" if value is None else f"{100.0 * value:.0f} %"

    return [
        f"{loop['x_m']:.1f}",
        f"{loop['y_m']:.1f}",
        f"{loop['from_s']:.1f}",
        f"{loop['back_at_s']:.1f}",
        str(loop["points"] or "-"),
        share(loop["on_map"]),
        share(loop["in_free"]),
        f"{loop['off_mm']:.0f}",
        f"{loop['off_deg']:.2f}",
    ]


def _reported(
    graph: SavedGraph, ends: np.ndarray, measured: Floats, on_map: Floats, points: np.ndarray, in_free: Floats
) -> list[dict[str, Any]]:
    off_m, off_rad = residuals(graph, ends, measured)
    seconds = (graph.stamp_ns - graph.stamp_ns.min()) / 1e9
    return [
        {
            "keyframes": [int(of), int(to)],
            "x_m": round(float(graph.map[to, 0]), 2),
            "y_m": round(float(graph.map[to, 1]), 2),
            "from_s": round(float(seconds[of]), 2),
            "back_at_s": round(float(seconds[to]), 2),
            "points": int(points[k]),
            "on_map": round(float(on_map[k]), 3),
            "in_free": None if np.isnan(in_free[k]) else round(float(in_free[k]), 3),
            "off_mm": round(1e3 * float(off_m[k]), 1),
            "off_deg": round(float(np.degrees(off_rad[k])), 3),
        }
        for k, (of, to) in enumerate(ends.tolist())
    ]
