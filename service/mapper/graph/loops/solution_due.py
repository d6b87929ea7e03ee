"""Decides when to optimise the graph, and when to render the map after it."""

import math
from collections.abc import Sequence

import numpy as np

from service.geometry.poses import Floats
from service.geometry.se2 import wrap_angle
from service.mapper.graph.model.keyframe_list import KeyframeList
from service.mapper.graph.model.loops import WITHIN_M, Loop, as_edges, disagreement
from service.mapper.graph.model.loops_config import LoopsConfig
from service.mapper.graph.model.pose_graph import edge_chi2

NEWEST_LOOPS = 20  # number of loops evaluated
MIN_RESIDUAL_CHI2 = 4.0  # of a loop: two sigmas
# Path length after which loops that agree with the map lead to a solution: each alone is below the threshold,
# but a drift that grows lap by lap is visible in all of them together.
SOLVE_EVERY_M = 100.0
RENDER_AT_M = 0.02  # less than half a cell of the shown map
LEVER_M = 10.0  # typical distance from a key frame to its walls


class SolutionDue:
    """Keeps the path length of the newest solution, and the motion of the map since it was rendered."""

    def __init__(self, config: LoopsConfig, path_length_m: float) -> None:
        """path_length_m: at the end of the stored map"""
        self._config = config
        self._solved_m = path_length_m
        self._unrendered_m = 0.0

    def is_due(self, keyframes: KeyframeList, loops: Sequence[Loop]) -> bool:
        """Whether one of the newest loops deviates from the map by more than its uncertainty, or
        SOLVE_EVERY_M were driven since the newest solution.
        """
        loops, path_length_m = loops[-NEWEST_LOOPS:], keyframes.path_length_m
        if path_length_m[-1] - self._solved_m >= SOLVE_EVERY_M and any(
            path_length_m[loop.to] > self._solved_m for loop in loops
        ):
            return True
        for loop, chi2 in zip(loops, edge_chi2(as_edges(loops), keyframes.map).tolist(), strict=True):
            off_m, off_rad = disagreement(keyframes, loop)
            if path_length_m[loop.to] <= path_length_m[-1] - WITHIN_M:
                continue
            if (
                off_m > self._config.solve_at_m and chi2 > MIN_RESIDUAL_CHI2
            ) or off_rad > self._config.solve_at_rad:
                return True
        return False

    def solved(self, path_length_m: float, before: Floats, after: Floats) -> None:
        """Record a solution that moved the key frames from `before`, (N, 3), to `after`."""
        self._solved_m = path_length_m
        away_m = np.hypot(*(after - before)[:, :2].T) + LEVER_M * np.abs(
            wrap_angle(after[:, 2] - before[:, 2])
        )
        self._unrendered_m += float(away_m.max(initial=0.0))

    def require_rendering(self) -> None:
        """Content was added to or removed from the map."""
        self._unrendered_m = math.inf

    def take_rendering(self) -> bool:
        """Whether the map has changed visibly since it was rendered; resets the count if so."""
        is_due = self._unrendered_m >= RENDER_AT_M
        if is_due:
            self._unrendered_m = 0.0
        return is_due
