"""Searches the place of a detached segment in the map."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.geometry.se2 import SE2
from service.mapper.components import PossiblePlace, UnconfirmedPlace
from service.mapper.graph.model.candidate_submap import EVIDENCE_RANGE_M, SeenCloud, seen_cloud
from service.mapper.graph.model.keyframe_list import KeyframeList, LoopsConfig
from service.mapper.graph.model.loops import Loop, loop_of
from service.mapper.graph.model.point_clouds import PointCloud
from service.mapper.graph.relocalise.expected_place import (
    ODOMETRY_PROBABILITY_CONTINUOUS,
    ODOMETRY_PROBABILITY_MEASURED,
    ODOMETRY_PROBABILITY_UNMEASURED,
    OdometryPrior,
    OperatorPose,
    places_in,
)
from service.mapper.graph.relocalise.known_map import (
    MAX_QUERY,
    MIN_MARGIN_NATS,
    Aligned,
    KnownMap,
    PlaceScore,
    fits,
    margin_of,
)
from service.mapper.graph.relocalise.place_search import (
    EXPECTED_WINDOW,
    REFINE_MARGIN_NATS,
    SAME_PLACE_M,
    find_places,
    is_same_place,
    is_same_pose,
)
from service.mapper.judgement import GAP_S
from service.mapper.known_pose import covariance_added

MAX_STATIONARY = 3  # of them from one viewpoint, besides the first
# Of dead reckoning without a scan gap, and per m of a segment.
MAX_ODOMETRY_ERROR_M, MAX_ODOMETRY_ERROR_SHARE = 4.0, 0.2
SEARCH_GRID_M = 10.0  # grid of the search area's centre
MIN_APART_M = 4.0  # between two results that confirm each other: from one viewpoint rooms may look alike
# Probability that any of the searched places fits as well by chance, if the vehicle is on unmapped ground.
MAX_CHANCE = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class CandidatePose:
    """A candidate place of a query in the known map."""

    pose: Floats  # (3,) of the reference key frame in the map
    score: PlaceScore
    loop: Loop | None  # to the nearest key frame; None if too little fits
    prior: float = 0.0  # nats: log-ratio of the odometry prior to a uniform one

    @property
    def evidence(self) -> float:
        """Nats of the beams and the odometry prior."""
        return self.score.evidence + self.prior


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """Place of a segment by one search: its odom in the map, and the loop."""

    pose_map_odom: Floats  # (3,)
    loop: Loop
    path_length_m: float
    segment: int
    is_sure: bool  # unmapped ground is excluded, and dead reckoning that leads elsewhere is contradicted


class DetachedSearch:
    """Searches the newest segment; keeps the result until a second one confirms it.

    known_map   search structures of the known map, if they are there; None: built when needed
    """

    def __init__(
        self, config: LoopsConfig, keyframes: KeyframeList, known_map: KnownMap | None = None
    ) -> None:
        self._config = config
        self._keyframes = keyframes
        self.operator_pose = OperatorPose(keyframes)  # searched first
        self._hypothesis: Hypothesis | None = None
        self._known_map = known_map
        self._is_session_placed = True  # False: the session has no place in the stored map
        self.possible: list[PossiblePlace] = []  # of the newest segment, as in PlaceUpdate
        self._query: SeenCloud | None = None  # of the newest search

    def make_ready(self, known: npt.NDArray[np.int64]) -> None:
        """Build the search structures before the first search. known (K,) as of find."""
        if len(known):
            self._map_of(known)

    def forget_map(self) -> None:
        """Discard the search structures: the points of the map have changed."""
        self._known_map = None

    def forget_numbers(self) -> None:
        """Discard indices: key frames were renumbered. Not while a segment is searched."""
        self._known_map = self._hypothesis = None

    @property
    def unconfirmed_place(self) -> UnconfirmedPlace | None:
        """Place of the segment by the newest result; None if there is none or the segment is placed.

        Also None if dead reckoning leads elsewhere and the query does not contradict that, or if other places
        are candidates, too, since new ground may look like any place of the map.
        """
        one = self._hypothesis
        if one is None or not one.is_sure or self.possible:
            return None
        return UnconfirmedPlace(one.segment, SE2(*one.pose_map_odom.tolist()))

    def find(self, known: npt.NDArray[np.int64]) -> tuple[Loop, ...] | None:
        """Place the newest segment in the map, and return the loops that prove it; None if not certain.

        known   (K,) indices of the key frames with a known place

        Searches the part of the known map within reach of dead reckoning, at every heading. Rooms may look
        alike, so one result is a hypothesis: its evidence must exceed that of any other place and of new
        ground by a margin, and the next key frames or dead reckoning must confirm it.
        """
        keyframes = self._keyframes
        self.possible = []
        segment = int(keyframes.segment[-1])
        is_in_stored = 0 < keyframes.stored < keyframes.count
        self._is_session_placed = not is_in_stored or bool((known >= keyframes.stored).any())
        if (placed := self.operator_pose.find(segment, known)) is not None:
            pose_map_odom, loop = placed
            self._place(segment, pose_map_odom)
            return (loop,)
        own = self._newest_of(segment)
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
        return self._judged(*best, reference, segment, prior)

    def _newest_of(self, segment: int) -> npt.NDArray[np.int64]:
        """(K,) newest key frames of a segment, without those of the first result."""
        keyframes, first = self._keyframes, self._hypothesis
        path_length_m = keyframes.path_length_m
        own = np.flatnonzero((keyframes.segment == segment) & keyframes.is_usable)
        from_m = path_length_m[-1] - self._config.place_m
        if first is not None and path_length_m[-1] - first.path_length_m >= MIN_APART_M:
            from_m = first.path_length_m + 0.5 * MIN_APART_M
        return np.array(own[path_length_m[own] >= from_m][-MAX_QUERY:])

    def _judged(
        self, at: Floats, loop: Loop, reference: int, segment: int, prior: OdometryPrior | None
    ) -> tuple[Loop, ...] | None:
        """The loops that prove a result of `find` at a pose in the map; None while it is a hypothesis."""
        keyframes = self._keyframes
        inverse = se2.between(keyframes.odom[reference], np.zeros(3))
        path_length_m = float(keyframes.path_length_m[reference])
        is_second = prior is not None and prior.explains(at)
        old = self._hypothesis
        agrees = old is not None and is_same_place(
            se2.compose(old.pose_map_odom, keyframes.odom[reference]), at
        )
        is_sure = is_second or not self._is_session_placed or (agrees and old is not None and old.is_sure)
        is_sure = (is_sure or self._excludes_new_ground(at, prior)) and not self._allows_dead_reckoning(prior)
        new = Hypothesis(se2.compose(at, inverse), loop, path_length_m, segment, is_sure)
        # A session gets its place by one result, since the vehicle may stand still; it is verified later.
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
        """Whether the last query does not contradict the pose of dead reckoning."""
        if prior is None or prior.is_vague or self._query is None or self._known_map is None:
            return False
        return self._known_map.align(self._query, prior.pose).score.evidence > -MIN_MARGIN_NATS

    def _is_possible(self, reference: int) -> bool:
        """Whether the newest result is among the candidate places."""
        if self._hypothesis is None:
            return False
        at = se2.compose(self._hypothesis.pose_map_odom, self._keyframes.odom[reference])
        return any(math.dist(at[:2], (place.x_m, place.y_m)) < SAME_PLACE_M for place in self.possible)

    def _excludes_new_ground(self, at: Floats, prior: OdometryPrior | None) -> bool:
        """Whether the last query excludes unmapped ground in favour of a pose (3,) of the map.

        Walls on new ground are like those of the rest of the building, and the number of places that fit by
        chance grows with the number of places searched; the required log-ratio accounts for it.
        """
        assert self._query is not None
        assert self._known_map is not None
        nats = self._known_map.structure(self._query, at)
        nats += 0.0 if prior is None else prior.nats(at)
        least = math.log(places_in(2.0 * math.pi * self._known_map.area_m2) / MAX_CHANCE)
        if nats < least:
            self.possible = [PossiblePlace(float(at[0]), float(at[1]), nats, least)]
        return nats >= least

    def _map_of(self, known: npt.NDArray[np.int64]) -> KnownMap:
        """The search structures, cached while the known map stays the same."""
        if self._known_map is None or not np.array_equal(self._known_map.known, known):
            self._known_map = KnownMap(self._keyframes, known)
        return self._known_map

    def _place(self, segment: int, pose_map_odom: Floats) -> None:
        keyframes = self._keyframes
        self.operator_pose.refuse(segment)
        mine = keyframes.segment == segment
        keyframes.map[mine] = se2.compose(pose_map_odom, keyframes.odom[mine])
        self._hypothesis = self._known_map = None

    def places_of(
        self,
        own: list[int],
        reference: int,
        known: npt.NDArray[np.int64],
        prior: OdometryPrior | None = None,
        reach_m: float = math.inf,
        expected: Sequence[Floats] = (),
    ) -> list[CandidatePose]:
        """Candidate places of the key frames `own` in the known map, the most likely by the beams first;
        within reach_m of dead reckoning. None is refined if none can exceed new ground in a session with a
        known place.

        expected   poses (3,) of the reference whose surroundings are searched; empty: the entire map
        """
        seen = seen_cloud(self._keyframes, own, reference)
        self._query = seen
        at_m = self._keyframes.map[reference, :2]
        near = [(pose, EXPECTED_WINDOW) for pose in expected]
        if prior is not None:
            near.append((prior.pose, prior.window))
        found = find_places(
            self._map_of(known),
            seen,
            near,
            not expected,
            self._is_session_placed,
            lambda one: not self._is_session_placed or _could_win(one, prior),
            lambda pose: math.dist(pose[:2], at_m) <= reach_m,
        )
        return [self._candidate(known, reference, one, seen.cloud, prior) for one in found]

    def _prior_of(
        self, reference: int, known: npt.NDArray[np.int64], last: int, reach_m: float
    ) -> OdometryPrior | None:
        """Prior of a key frame by odometry from `last`, the newest one with a known place; None without a
        motion model or a map.
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

    def best_of(
        self, found: list[CandidatePose], prior: OdometryPrior | None = None
    ) -> tuple[Floats, Loop] | None:
        """The place whose evidence exceeds every other by the margin, by beams or by structure; None if there
        is none.

        In a session with a known place it must also exceed unmapped ground, whose evidence is 0.
        """
        self.possible = []
        if not found:
            return None
        best = max(found, key=lambda place: place.evidence)
        if best.loop is None:
            return None
        margin = _margin(best.score.unexplained, prior is not None and prior.explains(best.pose))
        if self._is_session_placed and best.score.evidence < margin:
            return None
        for other in found:
            log_ratio = best.evidence - other.evidence
            # Beside the best place the same is unexplained.
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
        """Log-ratio of two places by walls and objects, each counted once, nats; 0 for the same room or
        without a search.
        """
        if self._query is None or self._known_map is None or is_same_place(best.pose, other.pose):
            return 0.0
        of_best, of_other = (self._known_map.structure(self._query, place.pose) for place in (best, other))
        return of_best + best.prior - of_other - other.prior

    def _log_ratio_where_known(self, best: CandidatePose, other: CandidatePose) -> float:
        """Log-ratio of two places by beams on ground known at the other one, nats; inf for the same room or
        without a search.
        """
        if self._query is None or self._known_map is None or is_same_place(best.pose, other.pose):
            return math.inf
        log_ratio = self._known_map.log_ratio_where_known(self._query, best.pose, other.pose)
        return log_ratio + best.prior - other.prior

    def _candidate(
        self,
        known: npt.NDArray[np.int64],
        reference: int,
        aligned: Aligned,
        cloud: PointCloud,
        prior: OdometryPrior | None,
    ) -> CandidatePose:
        """A candidate place, with a loop to the nearest key frame of the map if it fits well enough.

        Where dead reckoning confirms the place, its pose is fused with it, which fixes directions that walls
        leave open.
        """
        fit, score = aligned.fit, aligned.score
        is_at_dead_reckoning = prior is not None and prior.explains(fit.pose)
        if prior is not None and is_at_dead_reckoning:
            fit = prior.joined(fit)
        nats = 0.0 if prior is None else prior.nats(fit.pose)
        if not (is_at_dead_reckoning or fits(score.on_map, score.against)):
            return CandidatePose(fit.pose, score, None, nats)
        poses = self._keyframes.map
        of = int(known[np.argmin(np.hypot(*(poses[known, :2] - fit.pose[:2]).T))])
        information = se2.rotated(fit.information, -poses[of, 2])
        measured = se2.between(poses[of], fit.pose)
        loop = loop_of(of, reference, measured, information, score.on_map, len(cloud.xy), score.against)
        return CandidatePose(fit.pose, score, loop, nats)

    def _reach_m(self, segment: int, reference: int) -> float:
        """Largest distance of a key frame from dead reckoning, m; inf: anywhere.

        After a scan gap before the segment the vehicle may have been carried anywhere; a session without a
        place has no dead reckoning.
        """
        keyframes = self._keyframes
        first = int(np.flatnonzero(keyframes.segment == segment)[0])
        is_anywhere = not self._is_session_placed or segment in keyframes.unmeasured
        if is_anywhere or keyframes.gap_s[first] > GAP_S:
            return math.inf
        return MAX_ODOMETRY_ERROR_M + MAX_ODOMETRY_ERROR_SHARE * float(
            keyframes.path_length_m[reference] - keyframes.path_length_m[first]
        )

    def _within(self, known: npt.NDArray[np.int64], reference: int, reach_m: float) -> npt.NDArray[np.int64]:
        """Those of known (K,) that may see what is visible within reach_m of dead reckoning. Their set stays
        the same for some metres of driving.
        """
        if not math.isfinite(reach_m):
            return known
        poses = self._keyframes.map
        middle = SEARCH_GRID_M * np.round(poses[reference, :2] / SEARCH_GRID_M)
        most_m = SEARCH_GRID_M * (math.ceil((reach_m + EVIDENCE_RANGE_M) / SEARCH_GRID_M) + 1)
        is_near: npt.NDArray[np.bool_] = np.hypot(*(poses[known, :2] - middle).T) <= most_m
        return known[is_near]


def _margin(unexplained: float, is_at_dead_reckoning: bool) -> float:
    """As margin_of; where dead reckoning confirms the place, what the map does not explain is new ground."""
    return margin_of(0.0 if is_at_dead_reckoning else unexplained)


def _could_win(one: Aligned, prior: OdometryPrior | None) -> bool:
    """Whether a candidate may exceed new ground once refined, which adds REFINE_MARGIN_NATS at most."""
    unexplained = max(one.score.unexplained - REFINE_MARGIN_NATS, 0.0)
    least = _margin(unexplained, prior is not None and is_same_place(prior.pose, one.fit.pose))
    return one.score.evidence + REFINE_MARGIN_NATS >= least
