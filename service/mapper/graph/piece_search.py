"""Where a detached piece of the map lies in the rest, when nobody knows it."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.geometry import poses as se2
from service.mapper.graph.candidate_submap import LEAST_SCORE, CandidateSubmap, cloud_of
from service.mapper.graph.keyframe_list import Floats, KeyframeList
from service.mapper.graph.loops import Loop, loop_of
from service.mapper.graph.loops_config import LoopsConfig

PIECE_REACH_M, PIECE_STEP_RAD = 8.0, 0.03  # window in which a piece is looked for about each place
MOST_QUERY = 12  # key frames of a piece that are looked for together
CLEARLY_BETTER = 0.08  # of the returns: so much more must lie on the map than at any other place
SAME_PLACE_M, SAME_PLACE_RAD = 0.5, 0.1
CARRIED_S = 2.0  # without scans: a vehicle may have been carried
MOST_OFF_M, MOST_OFF_SHARE = 4.0, 0.2  # how far off dead reckoning may be else, and for each metre of a piece
LEAST_APART_M = 4.0  # between two finds of a piece: standing, a room looks like any other of its kind
# Of the points, so many may lie where the map knows that nothing stands: right finds have 0.000 to 0.005, a
# look-alike room entered from the other side 0.067.
PIECE_AGAINST = 0.03
PIECE_SHARE = 0.75  # of the drive's median share must lie on the map where a piece is found


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """Where a piece may lie: its odom in the map, and the loop that says so."""

    pose_map_odom: Floats  # (3,)
    loop: Loop
    way_m: float


class PieceSearch:
    """Looks for the newest piece of a keyframes of key frames; remembers the last find."""

    def __init__(self, config: LoopsConfig, keyframes: KeyframeList) -> None:
        self._config = config
        self._keyframes = keyframes
        self._hypothesis: Hypothesis | None = None

    def find(
        self, known: npt.NDArray[np.int64], submap_about: Callable[[int], CandidateSubmap]
    ) -> tuple[Loop, Loop] | None:
        """Move the newest piece to where it lies, and give the two loops that say so; None: nothing is sure.

        known      numbers of the key frames whose place in the map is known
        submap_about   the place about one of them

        It is asked of every stretch of the way, at every heading. One find is a hypothesis, since rooms look
        alike: it must fit clearly better than any other place, and the next key frames must say the same.
        """
        config, keyframes = self._config, self._keyframes
        piece = int(keyframes.piece[-1])
        own = np.flatnonzero((keyframes.piece == piece) & keyframes.is_usable)
        from_m = keyframes.way_m[-1] - config.place_m
        if self._hypothesis is not None and keyframes.way_m[-1] - self._hypothesis.way_m >= LEAST_APART_M:
            from_m = self._hypothesis.way_m + 0.5 * LEAST_APART_M  # none of what the first find has seen
        own = own[keyframes.way_m[own] >= from_m][-MOST_QUERY:]
        if not len(own) or not len(known):
            return None
        reference = int(own[-1])
        cloud = cloud_of(keyframes, own.tolist(), reference)
        found: list[tuple[float, Floats, Loop | None]] = []
        asked_m = -np.inf
        for k in known.tolist():
            if keyframes.way_m[k] < asked_m + config.place_m:
                continue
            asked_m = float(keyframes.way_m[k])
            submap = submap_about(k)
            pose = submap.search(cloud, np.zeros(3), PIECE_REACH_M, np.pi, LEAST_SCORE, PIECE_STEP_RAD)
            if pose is None:
                continue
            fit = submap.align(cloud, pose)
            loop = None
            if (
                fit.share >= PIECE_SHARE * float(np.median(keyframes.score))
                and submap.against(cloud, fit.pose) < PIECE_AGAINST
            ):
                loop = loop_of(submap.reference, reference, fit.pose, fit.information, fit.share)
            found.append((fit.share, se2.compose(keyframes.map[submap.reference], fit.pose), loop))
        share, at, loop = max(found, key=lambda f: f[0]) if found else (0.0, np.zeros(3), None)
        if loop is None or not self._could_be_at(at, piece, reference):
            self._hypothesis = None
            return None
        for other, other_at, _ in found:
            away = se2.between(at, other_at)
            if other > share - CLEARLY_BETTER and (
                np.hypot(away[0], away[1]) > SAME_PLACE_M or abs(away[2]) > SAME_PLACE_RAD
            ):
                self._hypothesis = None  # two places that look alike
                return None
        inverse = se2.between(keyframes.odom[reference], np.zeros(3))
        new = Hypothesis(se2.compose(at, inverse), loop, float(keyframes.way_m[reference]))
        old = self._hypothesis
        if old is None:
            self._hypothesis = new
            return None
        if new.way_m - old.way_m < LEAST_APART_M:
            return None
        self._hypothesis = new
        away = se2.between(se2.compose(old.pose_map_odom, keyframes.odom[reference]), at)
        if np.hypot(away[0], away[1]) > SAME_PLACE_M or abs(away[2]) > SAME_PLACE_RAD:
            return None
        mine = keyframes.piece == piece
        keyframes.map[mine] = se2.compose(new.pose_map_odom, keyframes.odom[mine])
        self._hypothesis = None
        return old.loop, new.loop

    def _could_be_at(self, at: Floats, piece: int, reference: int) -> bool:
        """Whether a key frame of a piece may lie at a pose (3,) of the map.

        Where scans went missing before the piece the vehicle may have been carried anywhere; where they did
        not it can be no farther from where dead reckoning puts it than that errs.
        """
        keyframes = self._keyframes
        first = int(np.flatnonzero(keyframes.piece == piece)[0])
        if keyframes.gap_s[first] > CARRIED_S:
            return True
        away = se2.between(keyframes.map[reference], at)
        way_m = float(keyframes.way_m[reference] - keyframes.way_m[first])
        return bool(np.hypot(away[0], away[1]) <= MOST_OFF_M + MOST_OFF_SHARE * way_m)
