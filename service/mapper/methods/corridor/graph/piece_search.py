"""Where a detached piece of the map lies in the rest, when nobody knows it."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.mapper.graph.point_clouds import Fit, PointCloud
from service.mapper.methods.corridor.graph.candidate_submap import LEAST_SCORE, CandidateSubmap, cloud_of
from service.mapper.methods.corridor.graph.keyframe_list import KeyframeList
from service.mapper.methods.corridor.graph.loops import Loop, loop_of
from service.mapper.methods.corridor.graph.loops_config import LoopsConfig
from service.mapper.methods.corridor.graph.map_field import MapField

REFINE_REACH = (1.0, 0.1)  # m, rad about a candidate: what the map is bent by between two passes
AROUND_M, MOST_AROUND = 6.0, 40  # key frames that what is seen at a candidate is held against
MOST_QUERY = 12  # key frames of a piece that are looked for together
CLEARLY_BETTER = 0.08  # of the returns: so much more must lie on the map than at any other place
SAME_PLACE_M, SAME_PLACE_RAD = 0.5, 0.1
CARRIED_S = 2.0  # without scans: a vehicle may have been carried
MOST_OFF_M, MOST_OFF_SHARE = 4.0, 0.2  # how far off dead reckoning may be else, and for each metre of a piece
LEAST_APART_M = 4.0  # between two finds of a piece: standing, a room looks like any other of its kind
# Of the points, so many may lie where the map knows that nothing stands: right finds have 0.000 to 0.005, a
# look-alike room entered from the other side 0.067.
PIECE_AGAINST = 0.03
# A session may begin where no key frame has stood, and see much that the map does not know. What it sees on
# known ground must lie on walls: 0.96 to 1.00 does at right places of simulated offices.
SESSION_SHARE, SESSION_AGREEMENT = 0.4, 0.94
EXPECTED_REACH, EXPECTED_TRIES = (1.5, 0.35), 10  # m, rad about a pose that is said; batches of key frames
PIECE_SHARE = 0.75  # of the drive's median share must lie on the map where a piece is found


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """Where a piece may lie: its odom in the map, and the loop that says so."""

    pose_map_odom: Floats  # (3,)
    loop: Loop
    way_m: float


class PieceSearch:
    """Looks for the newest piece among the key frames; remembers the last find."""

    def __init__(self, config: LoopsConfig, keyframes: KeyframeList) -> None:
        self._config = config
        self._keyframes = keyframes
        self._hypothesis: Hypothesis | None = None
        self._expected: Floats | None = None  # (3,) where a person says that the newest key frame is
        self._expected_odom: Floats | None = None  # the same: odom of the newest piece in the map
        self._tries = 0
        self.pose_refused: tuple[float, float, float] | None = None  # was said, and the piece is not there
        self._refused_piece = 0
        self._field: MapField | None = None
        self._is_session_placed = True  # False: of this session nothing is placed in the stored map
        self.alike: list[tuple[float, float]] = []  # m: the places that the newest piece fits equally well

    def expect_at(self, pose_map_base: Floats) -> None:
        """A person says where the vehicle is now, (3,) m, m, rad: looked at before all other places."""
        self._expected, self._expected_odom, self._tries = pose_map_base, None, EXPECTED_TRIES
        self.pose_refused = None

    def find(self, known: npt.NDArray[np.int64]) -> tuple[Loop, ...] | None:
        """Move the newest piece to where it lies, and give the loops that say so; None: nothing is sure.

        known   (K,) numbers of the key frames whose place in the map is known

        All of the known map is searched, at every heading. One find is a hypothesis, since rooms look
        alike: it must fit clearly better than any other place, and the next key frames must say the same.
        """
        config, keyframes = self._config, self._keyframes
        self.alike = []
        piece = int(keyframes.piece[-1])
        if piece != self._refused_piece:
            self.pose_refused = None
        is_in_stored = 0 < keyframes.stored < keyframes.count
        self._is_session_placed = not is_in_stored or bool((known >= keyframes.stored).any())
        if (expected := self._find_expected(piece, known)) is not None:
            return expected
        own = np.flatnonzero((keyframes.piece == piece) & keyframes.is_usable)
        from_m = keyframes.way_m[-1] - config.place_m
        if self._hypothesis is not None and keyframes.way_m[-1] - self._hypothesis.way_m >= LEAST_APART_M:
            from_m = self._hypothesis.way_m + 0.5 * LEAST_APART_M  # none of what the first find has seen
        own = own[keyframes.way_m[own] >= from_m][-MOST_QUERY:]
        if not len(own) or not len(known):
            return None
        reference = int(own[-1])
        best = self.best_of(self.places_of(own.tolist(), reference, known))
        if best is None or not self._could_be_at(best[0], piece, reference):
            self._hypothesis = None
            return None
        at, loop = best
        inverse = se2.between(keyframes.odom[reference], np.zeros(3))
        new = Hypothesis(se2.compose(at, inverse), loop, float(keyframes.way_m[reference]))
        if not self._is_session_placed:  # one find says where, for the vehicle may stand; it is proven later
            self._place(piece, new.pose_map_odom)
            return (loop,)
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
        self._place(piece, new.pose_map_odom)
        return old.loop, new.loop

    def _around(self, known: npt.NDArray[np.int64], pose: Floats) -> CandidateSubmap:
        """What key frames of all passes have seen around a pose (3,) of the map."""
        keyframes = self._keyframes
        away_m = np.hypot(*(keyframes.map[known, :2] - pose[:2]).T)
        nearest = known[np.argsort(away_m, kind="stable")[:MOST_AROUND]]
        near = nearest[np.sort(away_m)[:MOST_AROUND] <= max(AROUND_M, float(away_m.min()))]
        return CandidateSubmap(keyframes, np.sort(near).tolist(), int(near[0]), keyframes.map)

    def _field_of(self, known: npt.NDArray[np.int64]) -> MapField:
        """That of the search before, while the known map is the same: a piece is looked for many times."""
        if self._field is None or not np.array_equal(self._field.known, known):
            self._field = MapField(self._keyframes, known)
        return self._field

    def _place(self, piece: int, pose_map_odom: Floats, is_as_said: bool = False) -> None:
        keyframes = self._keyframes
        if self._expected is not None and not is_as_said:
            self._give_up_expected(piece)
        mine = keyframes.piece == piece
        keyframes.map[mine] = se2.compose(pose_map_odom, keyframes.odom[mine])
        self._hypothesis = self._expected = self._field = None

    def places_of(
        self, own: list[int], reference: int, known: npt.NDArray[np.int64]
    ) -> list[tuple[float, Floats, Loop | None]]:
        """Where in the known map the key frames `own` may lie: inlier ratio there, pose (3,) of `reference`
        in the map, and the loop that says so; None where too little fits.
        """
        keyframes = self._keyframes
        cloud = cloud_of(keyframes, own, reference)
        found: list[tuple[float, Floats, Loop | None]] = []
        for guess in self._field_of(known).candidates(cloud):
            submap = self._around(known, guess)
            near = se2.between(keyframes.map[submap.reference], guess)
            pose = submap.search(cloud, near, *REFINE_REACH, LEAST_SCORE)
            if pose is None:
                continue
            fit, loop = self._loop_at(submap, cloud, pose, reference)
            found.append((fit.share, se2.compose(keyframes.map[submap.reference], fit.pose), loop))
        return found

    def best_of(self, found: list[tuple[float, Floats, Loop | None]]) -> tuple[Floats, Loop] | None:
        """The place that fits clearly better than every other; None where there is none."""
        self.alike = []
        share, at, loop = max(found, key=lambda f: f[0]) if found else (0.0, np.zeros(3), None)
        if loop is None:
            return None
        for other, other_at, _ in found:
            away = se2.between(at, other_at)
            if other > share - CLEARLY_BETTER and (
                np.hypot(away[0], away[1]) > SAME_PLACE_M or abs(away[2]) > SAME_PLACE_RAD
            ):
                self.alike = [(float(at[0]), float(at[1])), (float(other_at[0]), float(other_at[1]))]
                return None
        return at, loop

    def _find_expected(self, piece: int, known: npt.NDArray[np.int64]) -> tuple[Loop, ...] | None:
        """Place the newest piece where a person has said, if it fits there; gives up after some tries."""
        keyframes = self._keyframes
        own = np.flatnonzero((keyframes.piece == piece) & keyframes.is_usable)[-MOST_QUERY:]
        if self._expected is None or not len(own) or not len(known):
            return None
        if self._expected_odom is None:
            newest = keyframes.odom[keyframes.count - 1]
            self._expected_odom = se2.compose(self._expected, se2.between(newest, np.zeros(3)))
        reference = int(own[-1])
        at = se2.compose(self._expected_odom, keyframes.odom[reference])
        submap = self._around(known, at)
        cloud = cloud_of(keyframes, own.tolist(), reference)
        guess = se2.between(keyframes.map[submap.reference], at)
        pose = submap.search(cloud, guess, *EXPECTED_REACH, LEAST_SCORE)
        loop = None if pose is None else self._loop_at(submap, cloud, pose, reference)[1]
        self._tries -= 1
        if loop is None:
            if self._tries == 0:
                self._give_up_expected(piece)
            return None
        found = se2.compose(keyframes.map[submap.reference], loop.measured)
        pose_map_odom = se2.compose(found, se2.between(keyframes.odom[reference], np.zeros(3)))
        self._place(piece, pose_map_odom, is_as_said=True)
        return (loop,)

    def _give_up_expected(self, piece: int) -> None:
        assert self._expected is not None
        x_m, y_m, theta_rad = self._expected.tolist()
        self._expected, self._refused_piece, self.pose_refused = None, piece, (x_m, y_m, theta_rad)

    def _loop_at(
        self, submap: CandidateSubmap, cloud: PointCloud, pose: Floats, reference: int
    ) -> tuple[Fit, Loop | None]:
        """How the points lie on a sub-map from a pose near enough; and the loop, if they fit."""
        fit = submap.align(cloud, pose)
        against = submap.against(cloud, fit.pose)
        if not self._is_session_placed:
            fits = fit.share >= SESSION_SHARE and fit.share >= SESSION_AGREEMENT * (fit.share + against)
        else:
            usual = float(np.median(self._keyframes.score))
            fits = fit.share >= PIECE_SHARE * usual and against < PIECE_AGAINST
        if not fits:
            return fit, None
        return fit, loop_of(
            submap.reference, reference, fit.pose, fit.information, fit.share, len(cloud.xy), against
        )

    def _could_be_at(self, at: Floats, piece: int, reference: int) -> bool:
        """Whether a key frame of a piece may lie at a pose (3,) of the map.

        Where scans went missing before the piece the vehicle may have been carried anywhere, and where
        nothing of the session is placed dead reckoning says nothing; else it can be no farther from where
        that puts it than it errs.
        """
        keyframes = self._keyframes
        if not self._is_session_placed:
            return True
        first = int(np.flatnonzero(keyframes.piece == piece)[0])
        if keyframes.gap_s[first] > CARRIED_S:
            return True
        away = se2.between(keyframes.map[reference], at)
        way_m = float(keyframes.way_m[reference] - keyframes.way_m[first])
        return bool(np.hypot(away[0], away[1]) <= MOST_OFF_M + MOST_OFF_SHARE * way_m)
