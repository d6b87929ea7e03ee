"""`corridor map loops`: accepted and refused loops of a stored map, with the reasons."""

from pathlib import Path
from typing import Any

import numpy as np

from service.errors import InputError
from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.mapper.by_hand import pairs_of
from service.mapper.loop_evidence import evidence, points_of
from service.mapper.saved_graph import SavedGraph
from service.mapstore.files import load_map


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
    """The accepted loops, and those that were measured and refused."""
    if not len(graph):
        return [], []
    names = ("ends", "measured", "covariance", "score", "points", "against")
    of_accepted = {name: getattr(graph, f"loop_{name}") for name in names}
    accepted, refused = (
        evidence(loops, graph.stamp_ns, graph.map, graph.path_length_m, int(graph.stamp_ns.min()))
        for loops in (of_accepted, graph.refused.by_field())
    )
    return [{"loop": k, **facts} for k, facts in enumerate(accepted)], refused


def as_pairs(graph: SavedGraph, ends: np.ndarray, measured: Floats) -> list[list[list[list[float]]]]:
    """Two pairs of points of the map for each loop, (2, 2, 2) m, that together give its measurement."""
    pairs = []
    for (of, to), second in zip(ends.tolist(), measured, strict=True):
        seen = points_of(second)
        of_map = (se2.points_from(graph.map[of], seen[:, 0]), se2.points_from(graph.map[to], seen[:, 1]))
        pairs.append(np.stack(of_map, axis=1).round(5).tolist())
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
