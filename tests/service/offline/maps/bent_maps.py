"""A stored map whose second round lies beside the first, and where its points truly are."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.mapper.graph.edit.editing import solved
from service.mapper.graph.loops.loop_back_end import Batch, LoopBackEnd
from service.mapper.graph.model.keyframe_list import LoopsConfig
from service.mapper.maps.occupancy import OccupancyConfig, OccupancyTiles
from service.mapper.saved_graph import SavedGraph
from service.mapstore.files import load_map, save_map
from service.outputs import TileUpdate
from tests.service.mapper.graph.loops.rings import LENGTH_M, STEP_M, WIDTH_M, key_frames

ROUND = round(2.0 * (LENGTH_M + WIDTH_M) / STEP_M)  # key frames
TURNED_RAD, SHIFTED_M = math.radians(6.0), (0.5, -0.4)  # of the second round, about where it begins


@dataclass(frozen=True)
class BentMap:
    """A ring of corridors driven 1.4 times without an error; then the second round was placed wrongly."""

    graph: SavedGraph
    truth: Floats  # (N, 3) pose_map_base
    tiles: Sequence[TileUpdate]  # as it is shown

    def error_m(self, graph: SavedGraph) -> float:
        """How far the key frame that lies worst is from the truth."""
        return float(np.hypot(*(graph.map[:, :2] - self.truth[:, :2]).T).max())

    def common_points(self, k: int) -> list[Floats]:
        """Three times a point as key frame k drew it on the map, and as k + ROUND did: (2, 2) m each."""
        first, second = self._points(k), self._points(k + ROUND)
        true_first, true_second = (
            se2.points_from(self.truth[of], xy) for of, xy in ((k, first), (k + ROUND, second))
        )
        away_m = np.hypot(*np.moveaxis(true_first[:, None] - true_second[None], -1, 0))
        rows = np.argsort(away_m.min(axis=1))
        chosen: list[int] = []
        for row in rows.tolist():
            if all(np.hypot(*(true_first[row] - true_first[other])) > 1.0 for other in chosen):
                chosen.append(row)
        return [
            np.stack(
                (
                    se2.points_from(self.graph.map[k], first[row]),
                    se2.points_from(self.graph.map[k + ROUND], second[int(away_m[row].argmin())]),
                )
            )
            for row in chosen[:3]
        ]

    def _points(self, k: int) -> Floats:
        begin = int(self.graph.point_count[:k].sum())
        return self.graph.xy_base[begin : begin + int(self.graph.point_count[k])].astype(np.float64)


@cache
def bent_map() -> BentMap:
    """Made once for all who look at it."""
    frames, truth = key_frames(1.4, turn_error_radpm=0.0)
    back_end = LoopBackEnd(LoopsConfig(consensus_span_m=1000.0), None)  # no loop is accepted
    for k in range(0, len(frames), 7):
        back_end.work(Batch(frames[k : k + 7]))
    graph = back_end.work(Batch([], is_last=True)).saved
    assert len(graph.loop_ends) == 0
    begin = graph.map[ROUND]
    moved = np.array([begin[0] + SHIFTED_M[0], begin[1] + SHIFTED_M[1], begin[2] + TURNED_RAD])
    poses, segment = graph.map.copy(), graph.segment.copy()
    poses[ROUND:] = se2.compose(moved, se2.between(begin, graph.map[ROUND:]))
    segment[ROUND:] = segment.max() + 1  # odometry does not relate it to the first round
    true_poses = np.array([(pose.x_m, pose.y_m, pose.theta_rad) for pose in truth])
    bent = replace(graph, map=poses, segment=segment)
    return BentMap(bent, true_poses, tiles_of(bent))


def save_bent(folder: Path, bent: BentMap) -> Path:
    """Stored as it was shown."""
    save_map(folder, bent.tiles, 1_000, {"vehicle": "veh1"}, graph=bent.graph)
    return folder


def tiles_of(graph: SavedGraph) -> list[TileUpdate]:
    shown = OccupancyTiles(OccupancyConfig(), 0.05)
    shown.replace_by(solved(graph, shown.renderer).rendered_map, ())
    return shown.changed_tiles()


def graph_in(folder: Path) -> SavedGraph:
    return load_map(folder).graph
