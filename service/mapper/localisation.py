"""Pose of odom in the map by the newest result of the graph, and the state it allows for a scan.

Also whether a detached segment stands still, where nothing but the scans matched to it measures the motion.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from service.estimator.motion import Matrix, Motion, Prediction
from service.geometry.se2 import SE2
from service.mapper.components import GraphUpdate, MapChange, Match, Placed, PlaceUpdate, PossiblePlace
from service.mapper.judgement import MAX_SIGMA_M, UNKNOWN_PLACE, judge_blank, sigmas_of
from service.mapper.known_pose import KnownPose
from service.outputs import Reason

UNPROVEN = Reason(
    "placed_once", "localised in the stored map from one viewpoint; drive on some metres to confirm it"
)
UNCONFIRMED_PLACE = Reason(
    "found_once", "found again in the map from one viewpoint; drive on some metres to confirm it"
)
NOT_PLACED = Reason("not_placed", "not localised in the stored map yet; drive on, or set the pose")


class Localisation:
    """Takes results of the graph; sets the state of each matched scan by its localisation in the map."""

    def __init__(self, placed: Placed) -> None:
        """placed: "unknown" if the session begins in a stored map, to be localised in."""
        self.pose_map_odom = SE2()  # of the newest scan
        self.place = PlaceUpdate(placed)
        self._known: KnownPose | None = None  # the newest key frame corrected by the graph
        self._known_here: KnownPose | None = None  # of the newest scan's place
        self._is_on_map = True  # else on a segment whose place in the map is unknown, or not confirmed
        self._placed_ns: int | None = None  # moment of the newest scan with returns; None: it was lost

    def take(self, update: GraphUpdate) -> None:
        """Take the localisation in a result of the graph."""
        if update.known is not None:
            self._known = update.known
        if update.place is not None:
            self.place = update.place

    def graph_ended(self) -> None:
        """Drop candidate places: the graph has stopped and searches for no segment any more."""
        self.place = PlaceUpdate(self.place.placed)

    def judged(
        self, match: Match, few: Reason, change: MapChange, pose_map_odom: SE2, at_ns: int, prior: Matrix
    ) -> Match:
        """The match, with the state that its place in the map allows.

        few             by too_few
        change          of the local map: number of the segment that the scan lies in
        pose_map_odom   of the graph
        at_ns           moment of the scan
        prior           (3, 3) covariance of the prediction, base axes
        """
        self.pose_map_odom, self._known_here = pose_map_odom, self._known
        if match.measured is not None:
            self._is_on_map = match.state != "lost"
        unconfirmed = self.place.unconfirmed_place
        if (
            unconfirmed is not None
            and match.state == "lost"
            and match.measured is not None  # it lies on the segment
            and change.segment == unconfirmed.segment
        ):
            self.pose_map_odom, self._known_here = unconfirmed.pose_map_odom, None
            match = match._replace(state="degraded", reason=UNCONFIRMED_PLACE)
        if self.place.placed == "unknown":
            match = match._replace(state="lost", reason=match.reason or NOT_PLACED)
        elif self.place.placed == "unproven" and match.state == "ok":
            match = match._replace(state="degraded", reason=UNPROVEN)
        if match.state == "lost":
            match = match._replace(reason=self._why_lost(match.reason))
        if few:  # neither measures nor contradicts
            if self._placed_ns is None:
                return match
            blank_s = (at_ns - self._placed_ns) * 1e-9
            state, reason = judge_blank(few, sigmas_of(prior), blank_s)
            return match._replace(state=state, reason=reason)
        self._placed_ns = at_ns if match.state != "lost" else None
        return match

    def covariance_of(self, motion: Motion) -> Matrix:
        """(3, 3) of a pose of the newest scan in the map, base axes."""
        known = self._known_here
        covariance = motion.covariance if known is None else known.covariance_at(motion)
        return covariance if self._is_on_map else covariance + UNKNOWN_PLACE

    def _why_lost(self, reason: Reason) -> Reason:
        """The reason, with the candidate places and the pose that was refused."""
        if self.place.possible:
            possible = _in_words(self.place.possible)
            is_unknown = self.place.placed == "unknown"
            words = f"{possible}; drive on, or set the pose" if is_unknown else f"{reason}; {possible}"
            reason = Reason("several_places", words)
        if self.place.pose_refused is not None:
            x_m, y_m, _ = self.place.pose_refused
            refused = f"the pose set at ({x_m:.1f}, {y_m:.1f}) m is rejected: no scan matches the map there"
            reason = Reason("pose_refused", f"{refused}; {reason}")
        return reason


def _in_words(places: Sequence[PossiblePlace]) -> str:
    if (least := places[0].least) is not None:
        at = f"({places[0].x_m:.1f}, {places[0].y_m:.1f}) m"
        evidence = f"{places[0].nats:.0f} nats of evidence, {least:.0f} would exclude that"
        return f"the scans match the map at {at}, but unmapped ground may look the same ({evidence})"
    several = " and ".join(f"({at.x_m:.1f}, {at.y_m:.1f}) m ({at.nats:.0f} nats)" for at in places)
    return f"the scans match the map about equally well at {several}"


class SegmentMotion:
    """People who walk beside a vehicle are a segment that moves with it: on it the vehicle seems to brake.

    The motion on a segment is compared with constant velocity since it began. Their distance is a sigma of
    the pose in the map. Beyond MAX_SIGMA_M the motion counts as unmeasured: the vehicle may have braked, or
    gone on together with the segment.
    """

    def __init__(self) -> None:
        self._began: tuple[int, Prediction] | None = None  # ns; None: there is no segment to compare
        self._is_unmeasured = False  # the motion on that segment
        self._is_paused = False  # no sensor measured the motion to the segment

    def predicted(self, at_ns: int, predicted: Prediction) -> tuple[Prediction, float]:
        """The prediction of a scan with the covariance of the segment's own motion, and for how long, s, the
        motion has not been measured, at the scan at which that shows; else 0.
        """
        if self._began is None:
            return predicted, 0.0
        if self._is_unmeasured:
            return replace(predicted, segment_covariance=UNKNOWN_PLACE), 0.0
        if predicted.increment is not None and not predicted.is_scan_alone:
            self._began = at_ns, predicted
            return predicted, 0.0
        began_ns, first = self._began
        elapsed_s = (at_ns - began_ns) * 1e-9
        constant_velocity = first.pose_odom_base @ SE2.exp(*(elapsed_s * speed for speed in first.twist_base))
        off = constant_velocity.between(predicted.pose_odom_base)
        off_m = math.hypot(off.x_m, off.y_m)
        if off_m <= MAX_SIGMA_M:
            return replace(predicted, segment_covariance=np.diag([off_m**2, off_m**2, 0.0])), 0.0
        self._is_unmeasured = True
        return replace(predicted, segment_covariance=UNKNOWN_PLACE), elapsed_s

    def matched(self, at_ns: int, predicted: Prediction, is_paused: bool, is_on_map: bool) -> None:
        """Take whether the scan of a prediction lay on the map, and not at most on a segment.

        is_paused   by is_motion_unmeasured
        """
        if is_on_map or is_paused:
            self._began, self._is_unmeasured, self._is_paused = None, False, is_paused
        elif self._began is None and not self._is_paused:
            self._began = at_ns, predicted
