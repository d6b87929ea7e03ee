"""Where a detached piece of the map lies in the rest, when nobody knows it."""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.geometry.se2 import SE2
from service.mapper.components import PossiblePlace, UnconfirmedPlace
from service.mapper.graph.model.candidate_submap import (
    MIN_LOOP_SCORE,
    CandidateSubmap,
    cloud_of,
)
from service.mapper.graph.model.keyframe_list import KeyframeList
from service.mapper.graph.model.loops import Loop, loop_of
from service.mapper.graph.model.loops_config import LoopsConfig
from service.mapper.graph.model.odometry_edges import MAX_SCAN_GAP_S
from service.mapper.graph.model.point_clouds import Fit, PointCloud
from service.mapper.graph.model.seen_cloud import EVIDENCE_RANGE_M, SeenCloud, seen_cloud
from service.mapper.graph.relocalise.known_map import Aligned, KnownMap, Weight
from service.mapper.graph.relocalise.odometry_prior import (
    ODOMETRY_PROBABILITY_CONTINUOUS,
    ODOMETRY_PROBABILITY_MEASURED,
    ODOMETRY_PROBABILITY_UNMEASURED,
    SEARCH_COVARIANCE,
    OdometryPrior,
    places_in,
)
from service.mapper.graph.relocalise.place_search import (
    REFINE_MARGIN_NATS,
    SAME_PLACE_M,
    find_places,
    is_same_place,
    is_same_pose,
)
from service.mapper.known_pose import KnownPose, covariance_added

AROUND_M, MAX_KEYFRAMES_AROUND = 6.0, 40  # key frames that what is seen where a person says is held against
MAX_QUERY = 12  # key frames of a piece that are looked for together
MAX_STATIONARY = 3  # of them, besides the first, of one spot, which see the same
# Nats by which the best place must beat every other one, as service.kernels.beam_likelihood weighs beams; and
# a share of what it leaves unexplained, since then the true place may fit worse than one that looks alike.
MIN_MARGIN_NATS, UNEXPLAINED_SHARE = 20.0, 0.5
MAX_OFF_M, MAX_OFF_SHARE = 4.0, 0.2  # how far off dead reckoning may be else, and for each metre of a piece
NEARBY_M = 10.0  # steps in which the part of the map that a piece may lie in follows the vehicle
MIN_APART_M = 4.0  # between two finds of a piece: standing, a room looks like any other of its kind
# Probability that any of the places searched fits by chance as well as the one that is found does, where the
# vehicle is on ground that the map does not hold.
MAX_CHANCE = 1e-4
# Where no key frame has stood, and where a piece comes from new ground, much is seen that the map does not
# know. So much must lie on the map, and of what is seen on known ground so much on walls.
MIN_ON_MAP, MIN_AGREEING = 0.3, 0.90
EXPECTED_REACH, EXPECTED_TRIES = (1.5, 0.35), 10  # m, rad about a pose that is said; batches of key frames


@dataclass(frozen=True, slots=True, eq=False)
class CandidatePose:
    """Where key frames may lie in the known map."""

    pose: Floats  # (3,) of the reference key frame in the map
    weight: Weight
    loop: Loop | None  # that says so; None where too little fits
    prior: float = 0.0  # nats: what the way there says, less that of a vehicle that may be anywhere

    @property
    def evidence(self) -> float:
        """Nats: of what is seen and of the way there."""
        return self.weight.evidence + self.prior


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """Where a piece may lie: its odom in the map, and the loop that says so."""

    pose_map_odom: Floats  # (3,)
    loop: Loop
    path_length_m: float
    segment: int
    is_disputed: bool  # the vehicle may as well be where dead reckoning leads
    is_sure: bool = True  # ground that the map does not hold is excluded


class DetachedSearch:
    """Looks for the newest piece among the key frames; remembers the last find."""

    def __init__(self, config: LoopsConfig, keyframes: KeyframeList) -> None:
        self._config = config
        self._keyframes = keyframes
        self._hypothesis: Hypothesis | None = None
        self._expected: Floats | None = None  # (3,) where a person says that the newest key frame is
        self._expected_odom: Floats | None = None  # the same: odom of the newest piece in the map
        self._tries = 0
        self.pose_refused: tuple[float, float, float] | None = None  # was said, and the piece is not there
        self._refused_segment = 0
        self._known_map: KnownMap | None = None
        self._is_session_placed = True  # False: of this session nothing is placed in the stored map
        self.possible: list[PossiblePlace] = []  # of the newest piece, as in PlaceNews
        self._query: SeenCloud | None = None  # of the newest search
        self._places: list[CandidatePose] = []  # that it found

    def expect_at(self, pose_map_base: Floats) -> None:
        """A person says where the vehicle is now, (3,) m, m, rad: looked at before all other places."""
        self._expected, self._expected_odom, self._tries = pose_map_base, None, EXPECTED_TRIES
        self.pose_refused = None

    def make_ready(self, known: npt.NDArray[np.int64]) -> None:
        """Make what places are looked for in; else the first search does. known (K,) as of find."""
        if len(known):
            self._map_of(known)

    def forget_map(self) -> None:
        """Other points are known from now on."""
        self._known_map = None

    def forget_numbers(self) -> None:
        """Key frames have other numbers from now on. Not while a piece is looked for."""
        self._known_map = self._hypothesis = None

    @property
    def unconfirmed_place(self) -> UnconfirmedPlace | None:
        """Where a piece lies if the newest find is right; None: there is none, or the piece is placed.

        Nor is it told where dead reckoning leads elsewhere and what is seen does not contradict that, or
        where other places are possible, too: new ground may look like any place of the map.
        """
        keyframes, one = self._keyframes, self._hypothesis
        if one is None or one.is_disputed or not one.is_sure or self.possible:
            return None
        k = one.loop.to
        known = KnownPose(
            SE2(*keyframes.odom[k].tolist()),
            keyframes.motion_covariance[k].copy(),
            one.loop.covariance + SEARCH_COVARIANCE,
        )
        return UnconfirmedPlace(one.segment, SE2(*one.pose_map_odom.tolist()), known)

    def find(self, known: npt.NDArray[np.int64]) -> tuple[Loop, ...] | None:
        """Move the newest piece to where it lies, and give the loops that say so; None: nothing is sure.

        known   (K,) numbers of the key frames whose place in the map is known

        All of the known map that the vehicle may have come to is searched, at every heading. One find is a
        hypothesis, since rooms look alike: it must fit clearly better than any other place and than new
        ground, and the next key frames must say the same, or dead reckoning.
        """
        config, keyframes = self._config, self._keyframes
        self.possible = []
        segment = int(keyframes.segment[-1])
        if segment != self._refused_segment:
            self.pose_refused = None
        is_in_stored = 0 < keyframes.stored < keyframes.count
        self._is_session_placed = not is_in_stored or bool((known >= keyframes.stored).any())
        if (expected := self._find_expected(segment, known)) is not None:
            return expected
        own = np.flatnonzero((keyframes.segment == segment) & keyframes.is_usable)
        from_m = keyframes.path_length_m[-1] - config.place_m
        if (
            self._hypothesis is not None
            and keyframes.path_length_m[-1] - self._hypothesis.path_length_m >= MIN_APART_M
        ):
            from_m = (
                self._hypothesis.path_length_m + 0.5 * MIN_APART_M
            )  # none of what the first find has seen
        own = own[keyframes.path_length_m[own] >= from_m][-MAX_QUERY:]
        if not len(own) or not len(known):
            return None
        reference, newest = int(own[-1]), int(known[-1])
        reach_m = self._reach_m(segment, reference)
        known = self._within(known, reference, reach_m)
        prior = self._prior_of(reference, known, newest, reach_m) if self._is_session_placed else None
        best = None
        if len(known):
            best = self.best_of(self.places_of(own.tolist(), reference, known, prior, reach_m), prior)
        if best is None:
            if not self._is_possible(reference):
                self._hypothesis = None
            return None
        at, loop = best
        inverse = se2.between(keyframes.odom[reference], np.zeros(3))
        path_length_m, is_disputed = (
            float(keyframes.path_length_m[reference]),
            self._allows_dead_reckoning(prior),
        )
        is_second = prior is not None and prior.explains(at)
        old = self._hypothesis
        agrees = old is not None and is_same_place(
            se2.compose(old.pose_map_odom, keyframes.odom[reference]), at
        )
        is_sure = is_second or not self._is_session_placed or (agrees and old is not None and old.is_sure)
        is_sure = is_sure or self._excludes_new_ground(at, prior)
        new = Hypothesis(se2.compose(at, inverse), loop, path_length_m, segment, is_disputed, is_sure)
        # Of a session one find says where, for the vehicle may stand; it is proven later.
        if is_second or not self._is_session_placed:
            self._place(segment, new.pose_map_odom)
            return (loop,)
        if old is None or not (old.is_sure and is_sure):
            self._hypothesis = new
            return None
        if path_length_m - old.path_length_m < MIN_APART_M:
            return None
        self._hypothesis = new
        if not agrees:
            return None
        self._place(segment, new.pose_map_odom)
        return old.loop, new.loop

    def _allows_dead_reckoning(self, prior: OdometryPrior | None) -> bool:
        """Whether what was asked for last does not contradict where dead reckoning leads."""
        if prior is None or prior.is_vague or self._query is None or self._known_map is None:
            return False
        return self._known_map.align(self._query, prior.pose).weight.evidence > -MIN_MARGIN_NATS

    def _is_possible(self, reference: int) -> bool:
        """Whether the newest find is one of the places that are possible now."""
        if self._hypothesis is None:
            return False
        at = se2.compose(self._hypothesis.pose_map_odom, self._keyframes.odom[reference])
        return any(math.dist(at[:2], (place.x_m, place.y_m)) < SAME_PLACE_M for place in self.possible)

    def _excludes_new_ground(self, at: Floats, prior: OdometryPrior | None) -> bool:
        """Whether what was asked for last can hardly be seen anywhere but at a pose (3,) of the map.

        Walls on new ground stand as in the rest of the building. The more places were searched, the more of
        them fit by chance; so as many times likelier must this one be than ground that nobody knows.
        """
        assert self._query is not None
        assert self._known_map is not None
        nats = self._known_map.structure(self._query, at)
        nats += 0.0 if prior is None else prior.nats(at)
        least = math.log(places_in(2.0 * math.pi * self._known_map.area_m2) / MAX_CHANCE)
        if nats < least:
            self.possible = [PossiblePlace(float(at[0]), float(at[1]), nats, least)]
        return nats >= least

    def _around(self, known: npt.NDArray[np.int64], pose: Floats) -> CandidateSubmap:
        """What key frames of all passes have seen around a pose (3,) of the map."""
        keyframes = self._keyframes
        away_m = np.hypot(*(keyframes.map[known, :2] - pose[:2]).T)
        nearest = known[np.argsort(away_m, kind="stable")[:MAX_KEYFRAMES_AROUND]]
        near = nearest[np.sort(away_m)[:MAX_KEYFRAMES_AROUND] <= max(AROUND_M, float(away_m.min()))]
        return CandidateSubmap(keyframes, np.sort(near).tolist(), int(near[0]), keyframes.map)

    def _map_of(self, known: npt.NDArray[np.int64]) -> KnownMap:
        """That of the search before, while the known map is the same: a piece is looked for many times."""
        if self._known_map is None or not np.array_equal(self._known_map.known, known):
            self._known_map = KnownMap(self._keyframes, known)
        return self._known_map

    def _place(self, segment: int, pose_map_odom: Floats, is_set_by_operator: bool = False) -> None:
        keyframes = self._keyframes
        if self._expected is not None and not is_set_by_operator:
            self._reject_expected(segment)
        mine = keyframes.segment == segment
        keyframes.map[mine] = se2.compose(pose_map_odom, keyframes.odom[mine])
        self._hypothesis = self._expected = self._known_map = None

    def places_of(
        self,
        own: list[int],
        reference: int,
        known: npt.NDArray[np.int64],
        prior: OdometryPrior | None = None,
        reach_m: float = math.inf,
        only_winners: bool = False,
    ) -> list[CandidatePose]:
        """Where in the known map the key frames `own` may lie, the likeliest by what is seen first; no
        farther than reach_m from where dead reckoning puts the reference.

        only_winners   refine none where none can be likelier than new ground
        """
        seen = seen_cloud(self._keyframes, own, reference)
        self._query = seen
        at_m = self._keyframes.map[reference, :2]

        def is_in_reach(pose: Floats) -> bool:
            return math.dist(pose[:2], at_m) <= reach_m

        guesses = [] if prior is None else [prior.pose]
        found = find_places(
            self._map_of(known),
            seen,
            guesses,
            lambda one: (prior is None and not only_winners) or _could_win(one, prior),
            is_in_reach,
        )
        self._places = [self._candidate(known, reference, one, seen.cloud, prior) for one in found]
        return self._places

    def _prior_of(
        self, reference: int, known: npt.NDArray[np.int64], last: int, reach_m: float
    ) -> OdometryPrior | None:
        """Of a key frame, by the way from `last`, the newest one of a known place; None: where no motion
        model says it, or no key frame of the map is near.
        """
        keyframes = self._keyframes
        step = se2.between(keyframes.odom[last], keyframes.odom[reference])
        then, now = keyframes.motion_covariance[last], keyframes.motion_covariance[reference]
        if not len(known) or not np.isfinite(then + now).all():
            return None
        region = 2.0 * math.pi * self._map_of(known).area_m2
        pose = se2.compose(keyframes.map[last], step)
        probability = (
            ODOMETRY_PROBABILITY_MEASURED if math.isinf(reach_m) else ODOMETRY_PROBABILITY_CONTINUOUS
        )
        if int(keyframes.segment[reference]) in keyframes.unmeasured:
            probability = ODOMETRY_PROBABILITY_UNMEASURED
        return OdometryPrior(pose, covariance_added(then, now, step), region, probability)

    def evidence_margin(self, pose_map: Floats) -> float:
        """Nats by which the pose (3,) in the map is likelier than every other place that the newest search
        found; inf where it found none, nan before the first. Where the pose is the truth and this is below 0,
        what was seen cannot tell it.
        """
        if self._query is None or self._known_map is None:
            return math.nan
        seen, known_map = self._query, self._known_map
        here = known_map.refine(seen, known_map.align(seen, pose_map)).weight
        others = [p.weight.evidence for p in self._places if not is_same_place(p.pose, pose_map)]
        return here.evidence - max(others, default=-math.inf)

    def best_of(
        self, found: list[CandidatePose], prior: OdometryPrior | None = None
    ) -> tuple[Floats, Loop] | None:
        """The place that is clearly likelier than every other, by the beams or by walls and things as such;
        None where there is none. Once a place is known in this session, clearly likelier also than ground
        that the map does not hold: there nothing that is seen speaks for or against.
        """
        self.possible = []
        if not found:
            return None
        best = max(found, key=lambda place: place.evidence)
        if best.loop is None:
            return None
        margin = _margin(best.weight.unexplained, prior is not None and prior.explains(best.pose))
        if self._is_session_placed and best.weight.evidence < margin:
            return None
        for other in found:
            log_ratio = best.evidence - other.evidence
            # Beside the best place the same is unexplained, so it says nothing there.
            least = MIN_MARGIN_NATS if is_same_place(best.pose, other.pose) else margin
            if log_ratio >= least and other.loop is not None:
                log_ratio, least = self._log_ratio_where_known(best, other), MIN_MARGIN_NATS
            if log_ratio >= least or is_same_pose(best.pose, other.pose):
                continue
            if self._log_ratio_by_structure(best, other) < MIN_MARGIN_NATS:
                self.possible = [
                    PossiblePlace(float(place.pose[0]), float(place.pose[1]), place.evidence)
                    for place in (best, other)
                ]
                return None
        return best.pose, best.loop

    def _log_ratio_by_structure(self, best: CandidatePose, other: CandidatePose) -> float:
        """Nats by which walls and things say that a place is likelier than another one, each of them once;
        0 where both are of one room, or nothing was searched for.
        """
        if self._query is None or self._known_map is None or is_same_place(best.pose, other.pose):
            return 0.0
        of_best, of_other = (self._known_map.structure(self._query, place.pose) for place in (best, other))
        return of_best + best.prior - of_other - other.prior

    def _log_ratio_where_known(self, best: CandidatePose, other: CandidatePose) -> float:
        """Nats by which a place is likelier than another one at which enough fits; inf where both are of one
        room, or nothing was searched for.
        """
        if self._query is None or self._known_map is None or is_same_place(best.pose, other.pose):
            return math.inf
        log_ratio = self._known_map.log_ratio_where_known(self._query, best.pose, other.pose)
        return log_ratio + best.prior - other.prior

    def _find_expected(self, segment: int, known: npt.NDArray[np.int64]) -> tuple[Loop, ...] | None:
        """Place the newest piece where a person has said, if it fits there; gives up after some tries."""
        keyframes = self._keyframes
        own = np.flatnonzero((keyframes.segment == segment) & keyframes.is_usable)[-MAX_QUERY:]
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
        pose = submap.search(cloud, guess, *EXPECTED_REACH, MIN_LOOP_SCORE)
        loop = None if pose is None else self._loop_at(submap, cloud, pose, reference)[1]
        self._tries -= 1
        if loop is None:
            if self._tries == 0:
                self._reject_expected(segment)
            return None
        found = se2.compose(keyframes.map[submap.reference], loop.measured)
        pose_map_odom = se2.compose(found, se2.between(keyframes.odom[reference], np.zeros(3)))
        self._place(segment, pose_map_odom, is_set_by_operator=True)
        return (loop,)

    def _reject_expected(self, segment: int) -> None:
        assert self._expected is not None
        x_m, y_m, theta_rad = self._expected.tolist()
        self._expected, self._refused_segment, self.pose_refused = None, segment, (x_m, y_m, theta_rad)

    def _loop_at(
        self, submap: CandidateSubmap, cloud: PointCloud, pose: Floats, reference: int
    ) -> tuple[Fit, Loop | None]:
        """How the points lie on a sub-map from a pose near enough; and the loop, if they fit."""
        fit = submap.align(cloud, pose)
        against = submap.against(cloud, fit.pose)
        if not _fits(fit.share, against):
            return fit, None
        return fit, loop_of(
            submap.reference, reference, fit.pose, fit.information, fit.share, len(cloud.xy), against
        )

    def _candidate(
        self,
        known: npt.NDArray[np.int64],
        reference: int,
        aligned: Aligned,
        cloud: PointCloud,
        prior: OdometryPrior | None,
    ) -> CandidatePose:
        """Where a key frame fits the known map, and if it fits well enough the loop that says so: with the
        key frame of that map next to it. Where dead reckoning leads there, it lies where both say: along
        walls that leave a direction open, dead reckoning says where.
        """
        fit, weight = aligned.fit, aligned.weight
        is_at_dead_reckoning = prior is not None and prior.explains(fit.pose)
        if prior is not None and is_at_dead_reckoning:
            fit = prior.joined(fit)
        nats = 0.0 if prior is None else prior.nats(fit.pose)
        if not (is_at_dead_reckoning or _fits(weight.on_map, weight.against)):
            return CandidatePose(fit.pose, weight, None, nats)
        poses = self._keyframes.map
        of = int(known[np.argmin(np.hypot(*(poses[known, :2] - fit.pose[:2]).T))])
        c, s = math.cos(poses[of, 2]), math.sin(poses[of, 2])
        turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        information = turn @ fit.information @ turn.T
        measured = se2.between(poses[of], fit.pose)
        loop = loop_of(of, reference, measured, information, weight.on_map, len(cloud.xy), weight.against)
        return CandidatePose(fit.pose, weight, loop, nats)

    def _reach_m(self, segment: int, reference: int) -> float:
        """How far from where dead reckoning puts it a key frame of a piece may lie in the map; inf: anywhere.

        Where scans went missing before the piece the vehicle may have been carried anywhere, and where
        nothing of the session is placed dead reckoning says nothing.
        """
        keyframes = self._keyframes
        first = int(np.flatnonzero(keyframes.segment == segment)[0])
        is_anywhere = not self._is_session_placed or segment in keyframes.unmeasured
        if is_anywhere or keyframes.gap_s[first] > MAX_SCAN_GAP_S:
            return math.inf
        return MAX_OFF_M + MAX_OFF_SHARE * float(
            keyframes.path_length_m[reference] - keyframes.path_length_m[first]
        )

    def _within(self, known: npt.NDArray[np.int64], reference: int, reach_m: float) -> npt.NDArray[np.int64]:
        """Those of known (K,) from where something can be seen that is seen from within reach_m of where dead
        reckoning puts a key frame: the same ones as the vehicle drives on, for some metres.
        """
        if not math.isfinite(reach_m):
            return known
        poses = self._keyframes.map
        middle = NEARBY_M * np.round(poses[reference, :2] / NEARBY_M)
        most_m = NEARBY_M * (math.ceil((reach_m + EVIDENCE_RANGE_M) / NEARBY_M) + 1)
        is_near: npt.NDArray[np.bool_] = np.hypot(*(poses[known, :2] - middle).T) <= most_m
        return known[is_near]


def _fits(on_map: float, against: float) -> bool:
    """Shares of what is seen: whether enough of it lies on the map, and little contradicts it."""
    return on_map >= MIN_ON_MAP and on_map >= MIN_AGREEING * (on_map + against)


def _margin(unexplained: float, is_at_dead_reckoning: bool) -> float:
    """Nats by which the evidence of a place must exceed that of others.

    is_at_dead_reckoning: dead reckoning confirms the place, so what the map does not explain is new ground.
    """
    return MIN_MARGIN_NATS + (0.0 if is_at_dead_reckoning else UNEXPLAINED_SHARE * unexplained)


def _could_win(one: Aligned, prior: OdometryPrior | None) -> bool:
    """Whether a candidate may be likelier than new ground, once refined: by REFINE_MARGIN_NATS at most."""
    unexplained = max(one.weight.unexplained - REFINE_MARGIN_NATS, 0.0)
    least = _margin(unexplained, prior is not None and is_same_place(prior.pose, one.fit.pose))
    return one.weight.evidence + REFINE_MARGIN_NATS >= least
