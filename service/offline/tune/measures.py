"""Cost of the result of a replay: against a truth, or by figures of the result itself. Less is better.

By itself: a map whose walls, seen from different passes, lie on one another, whose cells are sure, and whose
scans were placed. Map entropy as a measure without truth: Droeschel, Behnke, Efficient continuous-time SLAM
for 3D lidar-based online mapping, ICRA 2018; here of the cells of an occupancy grid.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from service.errors import InputError
from service.geometry.poses import Floats, points_from
from service.mapper.saved_graph import SavedGraph
from service.offline.past.result import open_result
from service.offline.score.score import RelationsScore, score
from service.outputs import TileUpdate

PASS_M = 5.0  # of the path: walls seen from further apart were placed independently of one another
WALL_CELL_M = 0.25  # in which a wall counts as straight
MIN_POINTS = 3  # of a pass in such a cell
MIN_STRAIGHT = 0.9  # length of the mean of its normals: a corner has less
OFFSET_M = 0.005  # between passes, by which two good maps still differ; as a weight against 0
LOST_WEIGHT = 10.0  # a drive that is lost throughout counts as so many times worse and one more


@dataclass(frozen=True, slots=True)
class Measured:
    """cost     what is minimised: m against a truth; by itself without unit
    parts    of it, to be shown, with the unit in the name
    """

    cost: float
    parts: dict[str, float]


def measure(result: Path, summary: dict[str, Any], truth: Path | None) -> Measured:
    """Cost of a replay; truth None: by itself. Raises InputError where the truth does not fit, or where a
    profile without a pose graph is to be measured by itself.
    """
    if truth is None:
        return _by_itself(result, summary)
    scored = score(result, truth)
    if isinstance(scored, RelationsScore):
        error = scored.errors[0]
        return Measured(
            error.translation_m.mean,
            {"relations_m": error.translation_m.mean, "relations_deg": error.rotation_deg.mean},
        )
    aligned_m = scored.ate_aligned_m.rms
    return Measured(aligned_m, {"ate_m": aligned_m, "ate_deg": scored.ate_aligned_deg.rms})


def _by_itself(result: Path, summary: dict[str, Any]) -> Measured:
    stored = open_result(result).stored
    if stored is None or stored.graph is None:
        raise InputError(
            f"{result}: the profile {summary['profile']} stores no pose graph, by which a result is measured "
            "without a truth; give --truth, or --profile corridor"
        )
    offset_m = pass_offset_m(stored.graph)
    entropy = map_entropy(stored.tiles)
    state, scans = summary["state"], max(summary["scans"], 1)
    lost, degraded = state["lost"] / scans, state["degraded"] / scans
    cost = (offset_m + OFFSET_M) / OFFSET_M * entropy * (1.0 + LOST_WEIGHT * lost + degraded)
    return Measured(
        cost, {"pass_offset_m": offset_m, "entropy_bit": entropy, "lost": lost, "degraded": degraded}
    )


def pass_offset_m(graph: SavedGraph) -> float:
    """Mean distance across a wall between its points as seen from passes PASS_M apart; 0 where no wall was
    seen from two of them.
    """
    xy, normals, passes = _placed(graph)
    cells = np.floor(xy / WALL_CELL_M).astype(np.int64)
    order = np.lexsort((passes, cells[:, 1], cells[:, 0]))
    keys = np.column_stack((cells, passes))[order]
    if not len(keys):
        return 0.0
    begins = np.flatnonzero(np.any(np.diff(keys, axis=0, prepend=keys[:1] - 1), axis=1))
    counts = np.diff(begins, append=len(keys))
    centre = np.add.reduceat(xy[order], begins) / counts[:, None]
    normal = np.add.reduceat(normals[order], begins) / counts[:, None]
    straight = (counts >= MIN_POINTS) & (np.hypot(*normal.T) > MIN_STRAIGHT)
    centre, normal, cell = centre[straight], normal[straight], keys[begins][straight, :2]
    same = (cell[1:] == cell[:-1]).all(axis=1) & ((normal[1:] * normal[:-1]).sum(axis=1) > MIN_STRAIGHT**2)
    across = np.abs(((centre[1:] - centre[:-1]) * normal[1:]).sum(axis=1))[same]
    return float(across.mean()) if len(across) else 0.0


def _placed(graph: SavedGraph) -> tuple[Floats, Floats, npt.NDArray[np.int64]]:
    """Points (M, 2) m and unit normals (M, 2) in the map, and the pass (M,) that each is of."""
    frame = np.repeat(np.arange(len(graph)), graph.point_count)
    pose = graph.map[frame]
    passes = np.floor(graph.path_length_m / PASS_M).astype(np.int64)
    normals = points_from(pose * (0.0, 0.0, 1.0), graph.normals[:, :2].astype(np.float64))
    return points_from(pose, graph.xy_base.astype(np.float64)), normals, passes[frame]


def map_entropy(tiles: Sequence[TileUpdate]) -> float:
    """Mean of the known cells, bit: 0 where each is surely free or occupied, 1 where all are unknown."""
    cells = np.concatenate([tile.cells.ravel() for tile in tiles if tile.level == 0])
    p = np.clip(cells[cells >= 0] / 100.0, 0.005, 0.995)
    return float((-p * np.log2(p) - (1.0 - p) * np.log2(1.0 - p)).mean()) if len(p) else 1.0
