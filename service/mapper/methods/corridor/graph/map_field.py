"""All of the known map as one field to search in: where a piece may lie, however far away."""

import math

import numpy as np
import numpy.typing as npt

from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.kernels.branch_and_bound import MaxPyramid, padding_cells, pool_levels, search_branch_and_bound
from service.kernels.loops import splat_field
from service.mapper.graph.point_clouds import CELL_M, PointCloud
from service.mapper.matchers.window_search import thinned, window_around
from service.mapper.methods.corridor.graph.candidate_submap import FIELD_SIGMA_M, LEAST_SCORE, LEVELS, REACH_M
from service.mapper.methods.corridor.graph.keyframe_list import KeyframeList

WINDOW_M = 8.0  # half a side of the squares that are searched one by one
STEP_RAD = 0.03
SEARCH_POINTS = 200
SCORE_BEHIND = 0.15  # a square whose best score is so far behind the best of all is no candidate
MOST_CANDIDATES = 8


class MapField:
    """The points of the key frames `known` (K,), where the graph has them now."""

    def __init__(self, keyframes: KeyframeList, known: npt.NDArray[np.int64]) -> None:
        self.known = known
        xy = np.concatenate([_points_of(keyframes, k) for k in known.tolist()])
        cells = np.floor(xy / CELL_M).astype(np.int64)
        low, high = cells.min(axis=0), cells.max(axis=0) + 3
        one_of = np.full((high[1] - low[1], high[0] - low[0]), -1, np.int64)
        one_of[cells[:, 1] - low[1], cells[:, 0] - low[0]] = np.arange(len(xy))
        xy = xy[one_of[one_of >= 0]]  # one of each cell says as much as all
        low = low - 2 - padding_cells(LEVELS)
        levels = np.zeros((LEVELS, high[1] - low[1], high[0] - low[0]), np.float32)
        splat_field(xy, int(low[1]), int(low[0]), CELL_M, FIELD_SIGMA_M, levels[0])
        pool_levels(levels, 0.0)
        self._pyramid = MaxPyramid(levels, int(low[1]), int(low[0]), 0.0, 0.0, 1.0, CELL_M)
        places = np.unique(np.floor(keyframes.map[known, :2] / (2.0 * WINDOW_M)).astype(np.int64), axis=0)
        around = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)])
        self._squares = np.unique((places[:, None] + around).reshape(-1, 2), axis=0)

    def candidates(self, cloud: PointCloud) -> list[Floats]:
        """Poses (3,) in the map, at most MOST_CANDIDATES, the likeliest first: the best of each square of
        16 m a side that is not far behind the best of all. The cloud is in the frame of the pose.
        """
        thin = thinned(cloud.xy, SEARCH_POINTS)
        found: list[tuple[float, Floats]] = []
        least = LEAST_SCORE
        for i, j in self._squares.tolist():
            centre = np.array([(2 * i + 1) * WINDOW_M, (2 * j + 1) * WINDOW_M, 0.0])
            window = window_around(centre, (WINDOW_M, math.pi), self._pyramid, STEP_RAD)
            best = search_branch_and_bound(thin, self._pyramid, window, least)
            if best.score >= least:
                found.append((float(best.score), best.pose))
                least = max(LEAST_SCORE, max(score for score, _ in found) - SCORE_BEHIND)
        found = [one for one in found if one[0] >= least]
        found.sort(key=lambda one: -one[0])
        return [pose for _, pose in found[:MOST_CANDIDATES]]


def _points_of(keyframes: KeyframeList, k: int) -> Floats:
    xy = keyframes.thinned[k].xy_base.astype(np.float64)
    near = (xy * xy).sum(axis=1) < REACH_M * REACH_M
    return se2.points_from(keyframes.map[k], xy[near])
