"""The matcher of the default profile: Gauss-Newton on surfels, with a coarse map for other initial poses."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
import numpy.typing as npt
from pydantic import Field

from service.estimator.motion import Measurement, Motion, Prediction
from service.geometry.se2 import SE2
from service.kernels.deskew import Returns
from service.kernels.filter_state import STUDENT
from service.kernels.likelihood import LikelihoodField
from service.kernels.match import MIN_PRIOR_WEIGHT, MatchResult, Prior, match_scan
from service.kernels.normals import ROUGH_WEIGHT
from service.mapper.components import Match, Points
from service.mapper.graph.model.point_clouds import ALIGNMENT
from service.mapper.judgement import (
    GAP_S,
    JUMP_CHI2,
    MAX_UNMEASURED_S,
    RECOVERY_HINT,
    Evidence,
    JudgementConfig,
    begun,
    chi2_between,
    is_contradicted,
    is_loose,
    judge,
    sigmas_of,
    too_few,
    unmatched,
)
from service.mapper.known_pose import adjoint_back
from service.mapper.matchers.window_search import (
    LOST_WINDOW,
    MIN_INLIER_GAIN,
    SEARCH_INTERVAL_S,
    Confirmation,
    layer_of,
    reach_of,
    search_around,
)
from service.mapper.scan_match.attempt import Aligned, Attempt, chi2_of, turned_about
from service.mapper.scan_match.moving_scene import MovingScene
from service.mapper.scan_match.posts import Posts, SeenWalls, posts_of, walls_seen
from service.mapper.scan_match.range_bias import RangeBias
from service.mapper.scan_match.reckoning import SteadyMotion, velocity_variance
from service.mapper.scan_match.small_objects import SmallObjects
from service.mapper.scan_match.submaps import SURFEL_SIGMA_M, Submap, SurfelSubmaps
from service.outputs import Reason, State

Matrix = npt.NDArray[np.float64]

CHANCE_M = 1.0  # of travel, over which chance information along an open direction accumulates
MAX_CHANCE_SCANS = 50.0  # scans within CHANCE_M that count in it
MAX_REPEATS = 100.0  # scans with the same noise of the map, at standstill
GAUSSIAN = 1e9  # degrees of freedom of a Gaussian error
LESS_LIKELY_CHI2 = 2.0 * math.log(10.0)  # a tenth as likely by the prediction
USUAL_SCANS = 50  # over which the usual inlier ratio is averaged
# Initial poses where odometry is wrong, m and rad: half a window, and the farthest.
START_WINDOW, MAX_START_REACH = (0.5, 0.25), (1.5, math.pi)
DOUBT_RATIO = 0.9  # factor on the usual inlier ratio, below which other initial poses are tried


SEGMENT_MAY_MOVE = Reason(
    "unmeasured_way",
    "the scans contradict the map, and against what they show the vehicle does not go on as before: it has "
    f"braked, or people walk along with it, which only odometry could tell. {RECOVERY_HINT}",
)


class SurfelMatcherConfig(JudgementConfig):
    """How a scan is aligned with the sub-map, and when the result is accepted."""

    wall_sigma_m: float = Field(default=0.004, gt=0.0)  # roughness of walls
    cauchy_m: float = Field(default=0.10, gt=0.0)  # distance at which a point has half its weight


@dataclass(frozen=True, slots=True, eq=False)
class _Gap:
    """Start of a detached segment, and the covariance of its pose in the map."""

    pose: SE2
    covariance: Matrix  # (3, 3) base axes


class SurfelGaussNewton:
    """Matcher[SurfelSubmaps]."""

    def __init__(self, config: SurfelMatcherConfig) -> None:
        self._config = config
        self._settings = ALIGNMENT._replace(
            surfel_sigma_m=SURFEL_SIGMA_M,
            wall_sigma_m=config.wall_sigma_m,
            cauchy_m=config.cauchy_m,
        )
        self._bias = RangeBias()
        self._usual_ratios: dict[str, float] = {}  # by laser
        self._steady = SteadyMotion()
        self._objects = SmallObjects(self._align, config.degraded_sigma_m)
        self._scene = MovingScene(self._align, self._steady, config.degraded_sigma_m)
        self._was_contradicted = False  # the prediction, by the previous scan
        self._next_search_ns = 0  # next wide search at the earliest
        # Since a scan fixed the position: time, s, and path, m; the speed then, m/s.
        self._since_fix, self._fixed_mps = (0.0, 0.0), 0.0
        self._gap: _Gap | None = None
        self._began: _Gap | None = None  # the gap of a segment that would begin with this scan
        self._detached: Submap | None = None  # the segment of `gap`
        self._confirmation = Confirmation()  # of a match of the segment with the map
        self._segment_covariance = np.zeros((3, 3))  # of its motion, as far as the motion model has it

    def bias_m(self, sensor: str) -> Matrix:
        """(NODES,) range bias of a laser, m; see RangeBias."""
        return self._bias.curve_m(sensor)

    def match(self, points: Points, predicted: Prediction, local_map: SurfelSubmaps) -> Match:
        seen = walls_seen(points, self._bias.curve_m(points.scan.sensor))
        points = seen.points
        if reason := too_few(points):
            return unmatched(points, predicted, reason)
        submap = local_map.matched_to
        if submap is None:
            return begun(points, predicted)
        if local_map.detached is not self._detached:
            self._detached = local_map.detached
            self._confirmation.clear()
            if self._detached is None:
                self._gap, self._segment_covariance = None, np.zeros((3, 3))
            else:  # a new segment at the predicted pose
                self._gap = self._began
        match = self._matched(self._attempt(seen, predicted), local_map, submap)
        if match.measured is not None:
            self._steady.matched(points.scan.stamp_ns, match.measured.pose_odom_base)
        return match

    def compare(self, points: Points, predicted: Prediction, local_map: SurfelSubmaps) -> Match:
        """The match near the prediction, within its covariance.

        Farther away more of a scan on new ground may lie on the map, because walls look alike.
        """
        seen = walls_seen(points, self._bias.curve_m(points.scan.sensor))
        points = seen.points
        if reason := too_few(points):
            return unmatched(points, predicted, reason)
        submap = local_map.matched_to
        if submap is None:
            return begun(points, predicted)
        attempt, aligned = self._aligned_near(seen, predicted, submap)
        if aligned.state == "lost":
            return unmatched(points, predicted, aligned.reason, aligned.result.share, aligned.is_contradicted)
        turned_about_sensor = turned_about(points.sensor_base, predicted)
        turned_attempt, turned = self._aligned_near(seen, turned_about_sensor, submap)
        match = self._as_match(aligned, attempt, aligned.state, aligned.reason)
        return match._replace(advantage=aligned.agreement(attempt) - turned.agreement(turned_attempt))

    def _aligned_near(
        self, seen: SeenWalls, predicted: Prediction, submap: Submap
    ) -> tuple[Attempt, Aligned]:
        attempt = self._attempt(seen, predicted)
        aligned = self._align(attempt, attempt.prior.pose, submap)
        if chi2_of(aligned.pose, attempt.prior) > JUMP_CHI2:
            attempt = attempt._replace(usual_ratio=0.0)  # no other initial pose is tried
            aligned = self._align(attempt, attempt.prior.pose, submap)
        return attempt, aligned

    def _attempt(self, seen: SeenWalls, predicted: Prediction) -> Attempt:
        points, on_walls, normals, has_posts = seen
        prior = _prior_of(predicted, self._gap)
        usual = self._usual_ratios.get(points.scan.sensor, 1.0)
        open_s, path_m = self._since_fix
        since_fix = open_s + predicted.elapsed_s, path_m + predicted.travel_m
        stamp_ns, posts = points.scan.stamp_ns, posts_of(points) if has_posts else None
        return Attempt(stamp_ns, on_walls, points, normals, posts, predicted, prior, usual, since_fix)

    def _matched(self, attempt: Attempt, local_map: SurfelSubmaps, submap: Submap) -> Match:
        if local_map.pause_s:
            is_silent = attempt.predicted.segment_covariance is None
            reason = _unmeasured(local_map.pause_s) if is_silent else SEGMENT_MAY_MOVE
            return self._on_segment(attempt, local_map, reason, 0.0, False)
        if (static := self._scene.match(attempt, submap)) is not None:
            return self._followed(static, attempt)
        aligned = self._objects.without(self._align(attempt, attempt.prior.pose, submap), attempt)
        is_usual = aligned.state != "lost" and aligned.result.share >= DOUBT_RATIO * attempt.usual_ratio
        if self._was_contradicted or not is_usual:
            aligned = self._searched(self._matched_at_constant_velocity(aligned, attempt), attempt)
        if aligned.state != "lost" and is_contradicted(aligned.evidence):
            aligned = self._matched_by_inertia(aligned, attempt)
        if aligned.state != "lost" and (self._gap is None or self._is_found(aligned, attempt)):
            aligned = self._scene.judge(aligned, attempt)
            if aligned.is_moving is not None:
                return self._followed(aligned, attempt)
            sensor, usual = attempt.points.scan.sensor, attempt.usual_ratio
            self._usual_ratios[sensor] = usual + (aligned.result.share - usual) / USUAL_SCANS
            self._learn_bias(aligned, attempt, local_map)
            self._was_contradicted = aligned.result.prior_weight < MIN_PRIOR_WEIGHT
            return self._followed(aligned, attempt)
        if self._gap is None and (static := self._scene.explain(attempt, submap)) is not None:
            return self._followed(static, attempt)
        return self._on_segment(
            attempt, local_map, aligned.reason, aligned.result.share, aligned.is_contradicted
        )

    def _on_segment(
        self,
        attempt: Attempt,
        local_map: SurfelSubmaps,
        reason: Reason,
        inlier_ratio: float,
        is_contradicted: bool,
    ) -> Match:
        """The match on the detached segment, if there is one; its state is lost for the given reason."""
        points, predicted = attempt.points, attempt.predicted
        self._since_fix = math.inf, math.inf
        self._began = _Gap(predicted.pose_odom_base, attempt.prior.covariance)
        if local_map.detached is None:
            return unmatched(points, predicted, reason, inlier_ratio, is_contradicted)
        attempt = attempt._replace(prior=_prior_of(predicted, None))
        detached = self._align(attempt, attempt.prior.pose, local_map.detached)
        if detached.state == "lost" or self._scene.is_displaced(attempt, detached):
            return unmatched(points, predicted, reason, inlier_ratio, is_contradicted)
        reason = reason.reworded(f"{reason}; a detached segment begins here until its place is found")
        match = self._as_match(detached, attempt, "lost", reason)
        moved = predicted.segment_covariance
        if not local_map.pause_s or moved is None or match.measured is None:
            return match
        # Until the graph has joined the segment, no scan is matched to the map with this in its prior.
        noise, self._segment_covariance = moved - self._segment_covariance, moved
        return match._replace(measured=match.measured._replace(segment_noise=noise))

    def _is_found(self, aligned: Aligned, attempt: Attempt) -> bool:
        """Whether a scan from a detached segment is accepted as matched to the map again.

        A match far from the prediction is a hypothesis, as rooms look alike; the next one must agree. A match
        that the path excludes is rejected; the graph searches the rest of the map.
        """
        if chi2_of(aligned.pose, attempt.prior) > JUMP_CHI2:
            return False
        if not is_loose(aligned.evidence.prior):
            return True
        return self._confirmation.confirms(aligned.pose, attempt.predicted.pose_odom_base)

    def _followed(self, aligned: Aligned, attempt: Attempt) -> Match:
        """The accepted match."""
        self._since_fix = attempt.since_fix
        if aligned.result.weakest_sigma_m <= self._config.degraded_sigma_m:
            self._since_fix, self._fixed_mps = (0.0, 0.0), math.hypot(*aligned.result.twist[:2].tolist())
        return self._as_match(aligned, attempt, aligned.state, aligned.reason)

    def _as_match(self, aligned: Aligned, attempt: Attempt, state: State, reason: Reason) -> Match:
        result, pose, gap, covariance = aligned.result, aligned.pose, None, aligned.result.covariance
        if state != "lost" and self._gap is not None:
            gap = attempt.prior.covariance - attempt.predicted.local_covariance
        measured = Measurement(pose, covariance, result.information, result.prior_weight, gap)
        forward, left, turn = result.twist.tolist()
        motion = Motion(pose, (forward, left, turn), covariance)
        moved_m = attempt.points.xy_base - attempt.unmoved.xy_base
        deskewed = attempt.unmoved._replace(xy_base=aligned.xy_base - moved_m)
        number, is_moving = aligned.submap.number, aligned.is_moving
        return Match(motion, deskewed, result.share, state, reason, number, measured, is_moving=is_moving)

    def _learn_bias(self, aligned: Aligned, attempt: Attempt, local_map: SurfelSubmaps) -> None:
        if self._gap is not None or aligned.result.share < DOUBT_RATIO * attempt.usual_ratio:
            return
        sensor = attempt.points.scan.sensor
        travel_m, step_m = attempt.predicted.travel_m, aligned.submap.keyframe_distance_m
        if attempt.posts is not None or not self._bias.is_due(sensor, travel_m, step_m):
            return
        deskewed, normals = attempt.points._replace(xy_base=aligned.xy_base), attempt.normals.copy()
        aligned.submap.weigh(deskewed, aligned.result.pose, aligned.submap.grid(), normals)
        offset_m = self._bias.learn(
            deskewed,
            normals,
            aligned.result.pose,
            aligned.submap,
            local_map.laser_of(sensor),
            self._settings._replace(range_sigma_m=attempt.points.range_sigma_m),
        )
        if offset_m:
            local_map.shorten(sensor, offset_m)

    def _align(
        self, attempt: Attempt, start: Matrix, submap: Submap, is_constrained: bool = False
    ) -> Aligned:
        """The match on a sub-map from the initial pose `start`, and its judgement.

        is_constrained: the prior is Gaussian.
        """
        points, predicted = attempt.points, attempt.predicted
        xy_base, normals, grid = points.xy_base.copy(), attempt.normals.copy(), submap.grid()
        if attempt.posts is None:
            submap.narrow_walls.direct(points, start, normals)
        submap.weigh(points, start, grid, normals)
        returns = Returns(points.xy_raw, points.beam_time_s, points.beam)
        if attempt.posts is not None:
            returns, normals, xy_base = _with_posts(attempt, attempt.posts, normals, start[2])
        is_scan_alone = predicted.is_scan_alone and not predicted.is_standing
        chance_chi2 = _chance_chi2(predicted)
        step_m = submap.keyframe_distance_m
        result: MatchResult = match_scan(
            returns,
            normals,
            attempt.prior,
            start,
            grid,
            # Half cells have noisier normals; where only scans measure the motion, chance would be followed.
            grid if is_scan_alone else submap.fine_grid(),
            self._settings._replace(
                range_sigma_m=points.range_sigma_m,
                repeats=max(1.0, step_m / max(predicted.travel_m, step_m / MAX_REPEATS)),
                chance_chi2=0.0 if is_scan_alone else chance_chi2,
                information_chance_chi2=chance_chi2,
                degrees_of_freedom=GAUSSIAN if is_constrained else STUDENT,
            ),
            DOUBT_RATIO * attempt.usual_ratio,
            xy_base,
        )
        pose, xy_base = SE2(*result.pose.tolist()), xy_base[: len(points.xy_base)]
        evidence = self._evidence(result, pose, xy_base, attempt, submap)
        return Aligned(result, pose, xy_base, submap, *judge(evidence, self._config), evidence)

    def _evidence(
        self, result: MatchResult, pose: SE2, xy_base: Matrix, attempt: Attempt, submap: Submap
    ) -> Evidence:
        prior = sigmas_of(attempt.prior.covariance)
        is_gap = self._gap is not None or attempt.predicted.elapsed_s > GAP_S
        is_far = (
            attempt.predicted.pause_s > GAP_S  # not measured: the vehicle may have been carried
            or chi2_of(pose, attempt.prior) > JUMP_CHI2
            or (is_gap and is_loose(prior))
        )
        open_s, path_m = attempt.since_fix
        open_m = max(path_m, open_s * self._fixed_mps) + math.sqrt(velocity_variance(open_s)[0])
        in_free, behind = 0, 0
        doubt_ratio = max(DOUBT_RATIO * attempt.usual_ratio, self._config.degraded_ratio)
        if is_far or result.share < doubt_ratio:
            in_free, behind = submap.contradicting(attempt.points, xy_base, attempt.normals, result.pose)
        return Evidence(
            used=result.used,
            on_map=result.share * result.used,
            in_free=in_free,
            sigma=sigmas_of(result.covariance),
            prior=prior,
            is_measured=attempt.predicted.is_measured,
            is_far=is_far,
            behind=behind,
            is_in_doubt=self._gap is not None,
            weakest=(result.weakest_sigma_m, result.weakest_direction_rad),
            open_m=open_m,
        )

    def _matched_at_constant_velocity(self, aligned: Aligned, attempt: Attempt) -> Aligned:
        """The match from the pose at constant velocity, if it has clearly more inliers: odometry may be dead.

        It is tried at a low inlier ratio; after a contradicted prediction always, and any gain is accepted.
        """
        share = aligned.result.share
        if share >= DOUBT_RATIO * attempt.usual_ratio and not self._was_contradicted:
            return aligned
        start = self._steady.pose_at(attempt.stamp_ns)
        if start is None:
            return aligned
        if chi2_of(start, attempt.prior) < JUMP_CHI2:
            return aligned  # the same initial pose
        found = self._align(attempt, np.array(start), aligned.submap)
        gain = 0.0 if self._was_contradicted else MIN_INLIER_GAIN
        return found if found.state != "lost" and found.result.share > share + gain else aligned

    def _searched(self, aligned: Aligned, attempt: Attempt) -> Aligned:
        """The best pose of a window around the prediction, if it has clearly more inliers.

        A wrong recovery is worse than none: a prediction can be corrected later, a jump cannot. Returns off
        the map may be on new ground, and elsewhere more of them may lie on it by chance. A match that the map
        does not contradict is therefore replaced only by a pose that is about as likely by the prediction.
        """
        prior = aligned.evidence.prior
        share = aligned.result.share
        if aligned.state != "lost" and (not is_loose(prior) or share >= DOUBT_RATIO * attempt.usual_ratio):
            return aligned
        reach_m, reach_rad = reach_of(prior)
        if aligned.state == "lost":
            if attempt.points.scan.stamp_ns < self._next_search_ns:
                return aligned
            self._next_search_ns = attempt.points.scan.stamp_ns + round(SEARCH_INTERVAL_S * 1e9)
            reach_m, reach_rad = max(reach_m, LOST_WINDOW[0]), max(reach_rad, LOST_WINDOW[1])
        start = _start_near(attempt, aligned.submap, attempt.predicted.pose_odom_base, (reach_m, reach_rad))
        if start is None:
            return aligned
        found = self._align(attempt, np.array(start), aligned.submap)
        if found.state == "lost" or found.result.share < share + MIN_INLIER_GAIN:
            return aligned
        less_likely = chi2_of(found.pose, attempt.prior) - chi2_of(aligned.pose, attempt.prior)
        return found if aligned.is_contradicted or less_likely <= LESS_LIKELY_CHI2 else aligned

    def _matched_by_inertia(self, aligned: Aligned, attempt: Attempt) -> Aligned:
        """The most likely match by inertia that the map confirms more than the accepted one; [37].

        The likelihood field does not count returns in free space: windows are searched one by one.
        """
        predicted, found = attempt.predicted, []
        position_m2, turn_rad2 = velocity_variance(min(predicted.elapsed_s, GAP_S))
        covariance = np.diag([position_m2, position_m2, turn_rad2])
        for centre in _windows_within(predicted.pose_odom_base, sigmas_of(covariance)):
            start = _start_near(attempt, aligned.submap, centre, START_WINDOW)
            if start is not None:
                found.append(self._align(attempt, np.array(start), aligned.submap))
        found = [one for one in found if one.state != "lost" and not one.is_contradicted]
        best = max((one.advantage for one in found), default=-1.0)
        if best < aligned.advantage + MIN_INLIER_GAIN:
            return aligned
        return min(
            (one for one in found if one.advantage >= best - MIN_INLIER_GAIN),
            key=lambda one: chi2_between(predicted.pose_odom_base, one.pose, covariance),
        )


def _start_near(attempt: Attempt, submap: Submap, centre: SE2, reach: tuple[float, float]) -> SE2 | None:
    """Initial pose of highest likelihood within (m, rad) of a pose."""
    grid = submap.grid()
    layer = layer_of(LikelihoodField(grid.tiles, grid.field, grid.cell_m))
    return search_around(attempt.points.xy_base, centre, reach, layer)


def _windows_within(pose: SE2, reach: tuple[float, float]) -> Iterator[SE2]:
    """Centres of windows of START_WINDOW about a pose, as far as (m, rad); none where one would do."""
    widths = [2.0 * half for half in START_WINDOW]
    steps, turns = np.ceil(np.minimum(reach, MAX_START_REACH) / widths - 0.5).astype(int).tolist()
    if not steps and not turns:
        return
    shifts_m = [widths[0] * k for k in range(-steps, steps + 1)]
    for k in range(-turns, turns + 1):
        for x_m, y_m in product(shifts_m, shifts_m):
            yield pose @ SE2(x_m, y_m, widths[1] * k)


def _with_posts(
    attempt: Attempt, posts: Posts, weighed: Matrix, heading_rad: float
) -> tuple[Returns, Matrix, Matrix]:
    """The points of a scan, followed by the centre of each post twice, weighed by the static score.

    weighed   (N, 3) normals of the points, after Submap.weigh; changed
    """
    points = attempt.points
    with np.errstate(divide="ignore", invalid="ignore"):
        static = np.nan_to_num(weighed[posts.point, 2] / attempt.normals[posts.point, 2], nan=0.0)
    weighed[posts.is_on_post, 2] = np.minimum(weighed[posts.is_on_post, 2], ROUGH_WEIGHT)
    weight = static * points.range_sigma_m**2 / posts.variance_m2
    return (
        Returns(
            np.vstack((points.xy_raw, np.repeat(posts.xy_raw, 2, axis=0))),
            np.concatenate((points.beam_time_s, np.repeat(posts.beam_time_s, 2))),
            np.concatenate((points.beam, np.repeat(posts.beam, 2))),
        ),
        np.vstack((weighed, posts.normals(heading_rad, weight))),
        np.vstack((points.xy_base, np.repeat(posts.xy_base, 2, axis=0))),
    )


def _unmeasured(pause_s: float) -> Reason:
    return Reason(
        "unmeasured_way",
        f"neither laser nor odometry measured the motion for {pause_s:.1f} s (at most {MAX_UNMEASURED_S:g} "
        "s; 1 s if odometry stops faster than a vehicle brakes); the vehicle may have been carried or towed",
    )


def _chance_chi2(predicted: Prediction) -> float:
    """Squared sigmas of chance that are subtracted from the information of a scan; [22]."""
    travel_m = max(predicted.travel_m, CHANCE_M / MAX_CHANCE_SCANS)
    return 2.0 * math.log(max(CHANCE_M / travel_m, 1.0))


def _prior_of(predicted: Prediction, gap: _Gap | None) -> Prior:
    """The prediction as a Prior; gap: covariance of a detached segment's start, propagated to here, and that
    of the segment's own motion.
    """
    pose = predicted.pose_odom_base
    if gap is not None:
        carry = adjoint_back(gap.pose.between(pose))
        added = carry @ gap.covariance @ carry.T
        if predicted.segment_covariance is not None:
            added += predicted.segment_covariance
        predicted = predicted.with_added_covariance(added)
    return Prior(
        np.array(pose), np.array(predicted.twist_base), predicted.local_covariance, predicted.twist_covariance
    )
