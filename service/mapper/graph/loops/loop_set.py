"""The loops of a graph: candidates, accepted, disabled and refused ones; when they lead to a solution."""

import math
from collections.abc import Sequence

import numpy as np

from service.geometry.poses import Floats
from service.geometry.se2 import wrap_angle
from service.mapper.graph.loops.old_passes import Renumbering
from service.mapper.graph.model.keyframe_list import KeyframeList, LoopsConfig
from service.mapper.graph.model.loops import (
    WITHIN_M,
    Loop,
    Refusals,
    agree,
    as_edges,
    loops_of,
)
from service.mapper.graph.model.path_drift import PathDrift
from service.mapper.graph.model.pose_graph import edge_chi2
from service.mapper.judgement import JUMP_CHI2
from service.mapper.loop_evidence import BY_HAND, CONTRADICTED, NOT_SUPPORTED, residuals
from service.mapper.saved_graph import LOOP_ROWS, SavedGraph

AGREE_M, AGREE_RAD = 0.15, 0.03  # tolerance between two consistent loops, without drift
MIN_RESIDUAL_CHI2 = 4.0  # of a loop: two sigmas
# Path length after which loops that agree with the map lead to a solution: each alone is below the threshold,
# but a drift that grows lap by lap is visible in all of them together.
SOLVE_EVERY_M = 100.0
RENDER_AT_M = 0.02  # less than half a cell of the shown map
LEVER_M = 10.0  # typical distance from a key frame to its walls


class LoopSet:
    """Accepts loops that agree with each other; disables those that a solution contradicts.

    accepted   in order of acceptance, after those of the stored map
    """

    def __init__(
        self, config: LoopsConfig, keyframes: KeyframeList, drift: PathDrift, stored: SavedGraph | None
    ) -> None:
        self._config, self._keyframes, self._drift = config, keyframes, drift
        self.accepted: list[Loop] = []
        if stored is not None:
            self.accepted = loops_of(*(getattr(stored, name) for name in LOOP_ROWS))
        self.refusals = Refusals(None if stored is None else stored.refused)
        self._groups: list[list[Loop]] = []  # accepted together, in order, for undo
        self._candidates: list[Loop] = []
        self._disabled: list[Loop] = []
        self._gone = 0, 0  # accepted and disabled loops of removed key frames

    @property
    def counts(self) -> tuple[int, int]:
        """Number of loops accepted and disabled, including those of removed key frames."""
        return len(self.accepted) + self._gone[0], len(self._disabled) + self._gone[1]

    def add(self, found: Sequence[Loop], newest_m: float) -> None:
        """Add loops of a search at a path length; accept those that others support."""
        for loop in found:
            self._candidates.append(loop)
            self.refusals.add([loop], NOT_SUPPORTED)
            self._accept(loop)
        path_length_m, oldest_m = self._keyframes.path_length_m, newest_m - 2.0 * WITHIN_M
        self._candidates = [loop for loop in self._candidates if path_length_m[loop.to] >= oldest_m]

    def add_of_finish(self, found: Sequence[Loop]) -> None:
        """Add loops of the search at the finish, which all others may support."""
        self._candidates = [*self.accepted, *found]
        self.refusals.add(found, NOT_SUPPORTED)
        for loop in found:
            if loop not in self.accepted:
                self._accept(loop)

    def accept(self, loops: Sequence[Loop]) -> None:
        """Accept loops together."""
        self.accepted += loops
        self._groups.append([*loops])

    def undo(self) -> bool:
        """Refuse the loops accepted last; whether there were any."""
        if not self._groups:
            return False
        gone = self._groups.pop()
        self.accepted = [loop for loop in self.accepted if loop not in gone]
        self.refusals.add(gone, BY_HAND)
        return True

    def disable_refuted(self) -> bool:
        """Disable loops beyond the chi-square gate at the newest solution; whether there was one."""
        is_refuted = edge_chi2(as_edges(self.accepted), self._keyframes.map) > JUMP_CHI2
        go = [self.accepted[k] for k in np.flatnonzero(is_refuted)]
        self.accepted = [loop for loop in self.accepted if loop not in go]
        self._disabled += go
        self.refusals.add(go, CONTRADICTED)
        return bool(go)

    def remove_segment(self, segment: int) -> None:
        """Remove the loops of a segment whose place was wrong."""
        of_segment = self._keyframes.segment == segment
        self.accepted = [loop for loop in self.accepted if not (of_segment[loop.of] or of_segment[loop.to])]
        self.drop_candidates()
        self.drop_undo()

    def drop_candidates(self) -> None:
        self._candidates = []

    def drop_undo(self) -> None:
        self._groups = []

    def renumber(self, new: Renumbering) -> None:
        """Keep only loops between key frames that are kept; counts stay as they are."""
        accepted, disabled = self.counts
        self.accepted, self._disabled = new.loops(self.accepted), new.loops(self._disabled)
        self._gone = accepted - len(self.accepted), disabled - len(self._disabled)
        self._candidates = new.loops(self._candidates)
        self._groups = [kept for group in self._groups if (kept := new.loops(group))]
        self.refusals.renumber(new.loops)

    def _accept(self, found: Loop) -> None:
        """Accept all candidates consistent with this loop, if they span a path or odometry confirms it."""
        config, path_length_m = self._config, self._keyframes.path_length_m
        base, growth = (AGREE_M, AGREE_RAD), (config.drift, config.drift_radpm)

        def is_consistent(loop: Loop) -> bool:
            is_near = abs(path_length_m[loop.to] - path_length_m[found.to]) <= WITHIN_M
            is_near &= abs(path_length_m[loop.of] - path_length_m[found.of]) <= 2.0 * WITHIN_M
            return is_near and agree(self._keyframes, found, loop, base, growth)

        if any(map(is_consistent, self.refusals.by_hand(self.accepted))):
            self.refusals.add([found], BY_HAND)
            return
        group = [loop for loop in self._candidates if is_consistent(loop)]
        is_one_spot = np.ptp([path_length_m[loop.to] for loop in group]) < config.consensus_span_m
        if is_one_spot and not self._drift.confirms(found):
            return
        new = [loop for loop in group if loop not in self.accepted and loop not in self._disabled]
        if new:
            self.accept(new)


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
        path_length_m = keyframes.path_length_m
        if path_length_m[-1] - self._solved_m >= SOLVE_EVERY_M and any(
            path_length_m[loop.to] > self._solved_m for loop in loops
        ):
            return True
        newest = as_edges([loop for loop in loops if path_length_m[loop.to] > path_length_m[-1] - WITHIN_M])
        off_m, off_rad = residuals(keyframes.map, np.column_stack((newest.of, newest.to)), newest.measured)
        is_significant = edge_chi2(newest, keyframes.map) > MIN_RESIDUAL_CHI2
        is_off = (off_m > self._config.solve_at_m) & is_significant | (off_rad > self._config.solve_at_rad)
        return bool(is_off.any())

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
