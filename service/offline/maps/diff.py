"""`corridor map diff`: what changed between two versions of a map, or between two maps in one frame."""

from pathlib import Path
from typing import Any

import numpy as np

from service.errors import InputError
from service.geometry import poses as se2
from service.mapper.saved_graph import SavedGraph
from service.mapstore.annotated import PALETTE, annotated
from service.mapstore.difference import COLOURS, Difference
from service.mapstore.files import StoredMap, load_map
from service.mapstore.png import write_png
from service.offline.writing import complete_files

MOVED_M, MOVED_RAD = 0.001, 0.0002  # a key frame that went so far has moved
LEAST_NEAR = 0.5  # of the walls: 0.93 to 0.99 of drives in one frame, 0.1 to 0.7 of others through one mall
_ROWS = {  # what is counted in both directions
    "area, m2": ("area_new_m2", "area_gone_m2"),
    "cells of walls": ("wall_cells_new", "wall_cells_gone"),
    "key frames": ("keyframes_new", "keyframes_gone"),
    "loops": ("loops_new", "loops_gone"),
    "points": ("points_new", "points_gone"),
}
Named = tuple[Path, int | None]  # folder, version


def map_diff(first: Named, second: Named, out: Path | None) -> dict[str, Any]:
    """Differences of the second map from the first, for JSON.

    out   file of a PNG that shows it; None: none is written

    Raises InputError where a map cannot be read or the two cannot be compared, StorageError where `out`
    cannot be written.
    """
    before, after = load_map(*first), load_map(*second)
    difference = Difference(before.tiles, after.tiles)
    counts = difference.counts()
    cell_m2 = difference.cell_m**2
    facts: dict[str, Any] = {
        "before": _name(first, before),
        "after": _name(second, after),
        "area_new_m2": round(counts.area_new * cell_m2, 2),
        "area_gone_m2": round(counts.area_gone * cell_m2, 2),
        "wall_cells_new": counts.walls_new,
        "wall_cells_gone": counts.walls_gone,
        "cells_changed": counts.changed,
    }
    has_common_keyframes = False
    if before.graph is not None and after.graph is not None:
        facts |= _graph_reported(before.graph, after.graph)
        has_common_keyframes = facts["keyframes_new"] < len(after.graph)
    warnings = [] if has_common_keyframes else _apart(difference)
    if out is not None:
        if out.suffix != ".png":
            raise InputError(f"{out}: the picture is a PNG; name a file that ends in .png")
        with complete_files(out) as path:
            write_png(path, annotated(difference.picture()), {**PALETTE, **COLOURS})
        facts["picture"] = str(out)
    return {**facts, "warnings": warnings, "problems": [*before.problems, *after.problems]}


def diff_table(facts: dict[str, Any]) -> tuple[list[list[str]], dict[str, Any]]:
    """Rows of words, heads first: what is counted in both directions beside each other; and the rest."""
    rows = [["", "new", "gone"]]
    rows += [[what, str(facts[new]), str(facts[gone])] for what, (new, gone) in _ROWS.items() if new in facts]
    in_table = {key for keys in _ROWS.values() for key in keys}
    return rows, {key: value for key, value in facts.items() if key not in in_table}


def _apart(difference: Difference) -> list[str]:
    """A warning where the maps are not in one frame, or of different places, as far as their walls tell."""
    common = difference.common()
    if common.walls and common.walls_near >= LEAST_NEAR * common.walls:
        return []
    return [
        f"the maps are not in one frame, or show different places: both know "
        f"{common.area * difference.cell_m**2:.1f} m2; of {common.walls} cells of walls that the second has "
        f"there, {common.walls_near} lie within a cell of a wall of the first. corridor map merge finds how "
        "two maps overlap"
    ]


def _name(named: Named, stored: StoredMap) -> str:
    return f"{named[0]}@{stored.number}"


def _graph_reported(before: SavedGraph, after: SavedGraph) -> dict[str, Any]:
    _, in_before, in_after = np.intersect1d(before.stamp_ns, after.stamp_ns, return_indices=True)
    off = se2.between(before.map[in_before], after.map[in_after])
    off_m, off_rad = np.hypot(off[:, 0], off[:, 1]), np.abs(off[:, 2])
    moved = (off_m > MOVED_M) | (off_rad > MOVED_RAD)
    points = after.point_count[in_after] - before.point_count[in_before]
    loops_before, loops_after = _loops(before), _loops(after)
    only_before = np.delete(np.arange(len(before)), in_before)
    only_after = np.delete(np.arange(len(after)), in_after)
    facts: dict[str, Any] = {
        "keyframes_new": len(only_after),
        "keyframes_gone": len(only_before),
        "loops_new": len(loops_after - loops_before),
        "loops_gone": len(loops_before - loops_after),
        "points_new": int(points[points > 0].sum()) + int(after.point_count[only_after].sum()),
        "points_gone": int(-points[points < 0].sum()) + int(before.point_count[only_before].sum()),
        "keyframes_moved": int(moved.sum()),
    }
    if moved.any():
        most = int(np.argmax(off_m))
        facts["moved"] = {
            "median_mm": round(1e3 * float(np.median(off_m[moved])), 1),
            "max_mm": round(1e3 * float(off_m[most]), 1),
            "max_deg": round(float(np.degrees(off_rad.max())), 3),
            "max_at_x_m": round(float(after.map[in_after[most], 0]), 2),
            "max_at_y_m": round(float(after.map[in_after[most], 1]), 2),
        }
    return facts


def _loops(graph: SavedGraph) -> set[tuple[int, int]]:
    """Each loop by the stamps of its two key frames."""
    return {(int(of), int(to)) for of, to in graph.stamp_ns[graph.loop_ends]}
