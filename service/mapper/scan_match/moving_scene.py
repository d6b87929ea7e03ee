"""Detection of scenes that move, by static walls and odometry; [35].

People who walk beside the vehicle make a scan match a vehicle at standstill. Hundreds of returns outweigh any
odometry, so a weight of the prediction does not help; the returns must be classified. Walls seen over
STATIC_PATH_M of the path are static, and no vehicle changes its speed at once. Both decide between two
hypotheses where the matched path differs from that of odometry and gyro:

    laser      the matched pose is right, and odometry errs
    odometry   the pose by odometry is right, and part of the scene moves

Sources: Haehnel, Triebel, Burgard, Thrun, Map building with mobile robots in dynamic environments, ICRA 2003
(a return belongs to the static map or does not); van de Ven, Ramos, Tipaldi, An integrated probabilistic
model for scan matching, moving object detection and motion estimation, ICRA 2010 (motion and association).
"""

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from service.estimator.motion import PAUSE_NS, Prediction
from service.geometry.chi2 import CHI2_999_OF_3
from service.geometry.se2 import SE2
from service.kernels.beam_likelihood import WALL_SIGMA_M
from service.kernels.filter_state import STUDENT
from service.kernels.match import Prior
from service.kernels.normals import ROUND_OBJECT_M
from service.kernels.wall_groups import group_by_wall
from service.mapper.judgement import JUMP_CHI2, MIN_CONFIRMING, is_loose, sigmas_of
from service.mapper.scan_match.attempt import Aligned, Attempt, Matrix, chi2_of
from service.mapper.scan_match.reckoning import (
    MATCH_COVARIANCE,
    MATCH_SIGMA_M,
    MATCH_SIGMA_RAD,
    USUAL,
    WINDOW_NS,
    Conflict,
    Reckoning,
    SteadyMotion,
    by_speed,
    inertia_cost,
)
from service.mapper.scan_match.submaps import STATIC_PATH_M, Submap
from service.outputs import NO_REASON, Reason, State

Mask = npt.NDArray[np.bool_]

OUTLIER_SHARE = 0.1  # of the returns, on no static wall; more while part of the scene moves
DECISIVE_SHARE = 0.5  # of the returns, or of the information about some direction
BEAMS_TOGETHER = 10  # neighbouring beams hit one object and form one measurement of it
# Prior log-odds that part of the scene moves rather than that odometry errs: where moving returns are
# observed, and where none are.
PRIOR_NATS = 5.0
MIN_STATIC_SHARE = 0.2  # of the returns on static walls, at either pose; below it only inertia counts
MIN_STATIC_AGREEMENT = 0.7  # of the beams that meet static walls or pass through them
ON_WALL_M = 0.05  # largest distance of an inlier from a static wall
NOTHING_MOVES = -1  # ns, before all stamps


def evidence_nats(of_odometry: Matrix, of_laser: Matrix, beam: npt.NDArray[np.int32]) -> float:
    """Log-likelihood ratio of the pose by odometry against that by the laser, by static walls, nats.

    of_odometry, of_laser   (N,) residuals at both poses, m; NaN without a static wall
    beam                    (N,) of the scan
    """
    ratio = _log_likelihood(of_odometry) - _log_likelihood(of_laser)
    group = beam // BEAMS_TOGETHER
    sums, counts = np.bincount(group, weights=ratio), np.bincount(group)
    return float((sums[counts > 0] / counts[counts > 0]).sum())


def _log_likelihood(residual_m: Matrix) -> Matrix:
    on_wall = np.exp(-0.5 * (np.nan_to_num(residual_m, nan=np.inf) / WALL_SIGMA_M) ** 2)
    likelihood: Matrix = np.log(OUTLIER_SHARE + (1.0 - OUTLIER_SHARE) * on_wall)
    return likelihood


class MovingScene:
    """Monitors the matches and replaces those that moving objects have displaced.

    align               (attempt, start (3,), sub-map, is_constrained) -> the match; is_constrained: the
                        prior is Gaussian
    steady              the motion of the matches
    degraded_sigma_m    above this sigma a direction is unobservable
    """

    def __init__(
        self,
        align: Callable[[Attempt, Matrix, Submap, bool], Aligned],
        steady: SteadyMotion,
        degraded_sigma_m: float,
    ) -> None:
        self._align = align
        self._steady = steady
        self._degraded_sigma_m = degraded_sigma_m
        self._reckoning = Reckoning()
        self._moves_until_ns = NOTHING_MOVES  # at least
        self._has_displaced = False  # whether moving objects displace matches of entire scans
        self._has_moved = False  # part of the scene, in the newest judged scan
        # Since the last observation of motion: accumulated steps from the static match to that of the entire
        # scan, the variance of odometry beyond its model, and path length.
        self._drift, self._drift_m2, self._drift_rad2, self._path_length_m = SE2(), 0.0, 0.0, 0.0
        self._moving_path_m = 0.0  # by odometry, since part of the scene began to move

    def match(self, attempt: Attempt, submap: Submap) -> Aligned | None:
        """The match of the static returns while part of the scene moves.

        None: the scene is static again, or its static part contradicts odometry.
        """
        if attempt.stamp_ns > self._moves_until_ns:
            self._moving_path_m = 0.0
            return None
        if not self._reckoning.is_silent:
            self._moving_path_m += attempt.predicted.travel_m
        static, _share = self._align_static(attempt, attempt.prior, submap)
        # With odometry the pose follows it where few are in view; not in the first metre, where none can be.
        is_needed = self._reckoning.is_silent or not submap.knows_static
        is_unconfirmed = is_needed and static.result.used < MIN_CONFIRMING
        if is_unconfirmed or is_loose(sigmas_of(static.result.covariance)):
            self._moves_until_ns = NOTHING_MOVES
            return None
        conflict = self._reckoning.add(attempt.stamp_ns, attempt.predicted, static.pose)
        if conflict is None:
            if self._is_needed(static, attempt):
                return self._accepted(static, attempt)
        elif not conflict.is_turned:
            self._has_displaced = True
            by_odometry, _share = self._align_static(attempt, _prior_at(conflict, attempt), submap)
            if self._evidence_nats(attempt, by_odometry, static) + PRIOR_NATS >= 0.0:
                return self._start(by_odometry, attempt)
        self._moves_until_ns = NOTHING_MOVES
        return None

    def judge(self, aligned: Aligned, attempt: Attempt) -> Aligned:
        """An accepted match, replaced by that of the static returns where moving ones have displaced it."""
        conflict = self._reckoning.add(attempt.stamp_ns, attempt.predicted, aligned.pose)
        if attempt.predicted.elapsed_s > PAUSE_NS * 1e-9:
            self._reckoning.restart(attempt.stamp_ns, aligned.pose)
            return aligned
        if conflict is None and not self._reckoning.is_silent and aligned.result.share > 1.0 - OUTLIER_SHARE:
            self._has_moved = False
            return aligned
        is_seen_moving = self._is_seen_moving(aligned, attempt)
        # Motion is visible in two consecutive scans; in one alone some returns are off the map by chance.
        moves, self._has_moved = is_seen_moving and self._has_moved, is_seen_moving
        if conflict is None and not moves:
            return aligned
        prior = attempt.prior if conflict is None else _prior_at(conflict, attempt)
        static, share = self._align_static(attempt, prior, aligned.submap)
        is_moving, is_static = _classified(attempt, aligned.submap, aligned.xy_base, aligned.result.pose)
        self._has_displaced = conflict is not None
        if not self._is_needed(static, attempt):  # odometry agrees with the entire scan
            return aligned._replace(is_moving=is_moving)
        if max(share, is_static.mean()) >= MIN_STATIC_SHARE:
            nats = self._evidence_nats(attempt, static, aligned)
            # People ahead in a bare corridor measure how far the vehicle went, but not its heading.
            if conflict is not None and not conflict.is_turned and is_static.mean() >= DECISIVE_SHARE:
                moves = moves or _is_decisive(is_moving, attempt)
            nats += PRIOR_NATS if moves else -PRIOR_NATS
        elif conflict is None:
            return aligned
        else:
            nats = self._inertia_nats(attempt, aligned)
            is_off_walls = _share_on_walls_only_at(static, aligned, attempt) >= OUTLIER_SHARE
            is_moving_known = is_seen_moving and aligned.submap.knows_static
            nats += PRIOR_NATS if is_off_walls or is_moving_known else -PRIOR_NATS
        # Static returns that fix the pose and contradict odometry as well confirm the entire scan.
        contradicts = conflict is not None and chi2_of(static.pose, prior) > CHI2_999_OF_3
        if nats >= 0.0 and not (contradicts and self._is_fixed(static)):
            return self._start(static, attempt)
        if conflict is not None and share > 0.0:  # in a map's first metre later scans may still decide
            self._reckoning.restart(attempt.stamp_ns, aligned.pose)
        return aligned

    def explain(self, attempt: Attempt, submap: Submap) -> Aligned | None:
        """The static match near the prediction, for a scan that the map contradicts; None: it does not fit.

        Moving objects may hide walls, but no beam passes through a wall.
        """
        if not _is_witnessed(attempt.predicted):
            self._reckoning.clear()
            return None
        static, _share = self._align_static(attempt, attempt.prior, submap)
        pose, xy_base = static.result.pose, static.xy_base
        residual_m = submap.static_residuals(xy_base, attempt.normals, pose)
        on_walls = int(_is_on_wall(residual_m).sum())
        through = submap.beams_through_static(attempt.points, xy_base, pose)
        if (
            on_walls < MIN_CONFIRMING
            or on_walls < MIN_STATIC_AGREEMENT * (on_walls + through)
            or is_loose(sigmas_of(static.result.covariance))
        ):
            self._reckoning.clear()
            return None
        self._has_displaced = True
        return self._start(static, attempt)

    def is_displaced(self, attempt: Attempt, detached: Aligned) -> bool:
        """Whether moving objects have displaced a match on a detached sub-map.

        It has no static walls yet, so inertia alone is the evidence. The prior is that of visible motion: the
        scan contradicts the map.
        """
        if not _is_witnessed(attempt.predicted) or chi2_of(detached.pose, attempt.prior) <= JUMP_CHI2:
            return False
        if self._inertia_nats(attempt, detached) + PRIOR_NATS < 0.0:
            return False
        self._steady.matched(attempt.stamp_ns, attempt.predicted.pose_odom_base)
        return True

    def _evidence_nats(self, attempt: Attempt, by_odometry: Aligned, by_laser: Aligned) -> float:
        """Log-likelihood ratio of odometry against the laser, by static walls and inertia, on one sub-map."""
        of_odometry, of_laser = (
            one.submap.static_residuals(one.xy_base, attempt.normals, one.result.pose)
            for one in (by_odometry, by_laser)
        )
        nats = evidence_nats(of_odometry, of_laser, attempt.points.beam)
        return nats + self._inertia_nats(attempt, by_laser)

    def _inertia_nats(self, attempt: Attempt, by_laser: Aligned) -> float:
        """The part of inertia; 0 where the motion of the last matches is unknown."""
        last, constant_velocity = self._steady.last, self._steady.pose_at(attempt.stamp_ns)
        predicted = attempt.predicted
        if last is None or constant_velocity is None or not predicted.is_measured:
            return 0.0
        step = predicted.increment or by_speed(predicted)
        covariance = attempt.prior.covariance + MATCH_COVARIANCE
        newest = [
            inertia_cost(constant_velocity, pose, predicted.elapsed_s, covariance)
            for pose in (last @ step.pose, by_laser.pose)
        ]
        odometry_cost, laser_cost = map(max, newest, self._reckoning.inertia_costs())
        return laser_cost - odometry_cost

    def _align_static(self, attempt: Attempt, prior: Prior, submap: Submap) -> tuple[Aligned, float]:
        """The match of the points on static walls, from a prior, and their share of all points."""
        _, is_static = _classified(attempt, submap, attempt.points.xy_base, prior.pose, self._moving_path_m)
        normals = attempt.normals.copy()
        normals[~is_static, 2] = 0.0
        static = attempt._replace(normals=normals, prior=prior)
        return self._align(static, prior.pose, submap, True), float(is_static.mean())

    def _start(self, static: Aligned, attempt: Attempt) -> Aligned:
        self._reckoning.restart(attempt.stamp_ns, static.pose)
        self._moves(attempt)
        return self._accepted(static, attempt)

    def _moves(self, attempt: Attempt) -> None:
        self._moves_until_ns = attempt.stamp_ns + WINDOW_NS
        self._drift, self._drift_m2, self._drift_rad2, self._path_length_m = SE2(), 0.0, 0.0, 0.0

    def _accepted(self, static: Aligned, attempt: Attempt) -> Aligned:
        """The static match with Student's weight of the prediction, and its moving returns marked."""
        is_moving, _is_static = _classified(attempt, static.submap, static.xy_base, static.result.pose)
        moving_share = float(is_moving.mean())
        if self._is_seen_moving(static, attempt) or self._is_drifting(static, attempt):
            self._moves(attempt)
        state: State = "ok"
        reason = NO_REASON
        if not self._is_fixed(static):
            state = "degraded"
            reason = Reason(
                "scene_moves",
                f"{moving_share:.0%} of the returns move or lie where nothing stood before, and what stands "
                "still does not fix the position; the pose follows the prediction there. Wait until it has "
                "passed, or drive on",
            )
        chi2 = chi2_of(static.pose, attempt.prior)
        weight = min(1.0, (STUDENT + 3.0) / (STUDENT + chi2))
        result = static.result._replace(prior_weight=weight)
        return static._replace(result=result, state=state, reason=reason, is_moving=is_moving)

    def _is_needed(self, static: Aligned, attempt: Attempt) -> bool:
        """Whether the static returns may replace the entire scan: not where they leave a direction open and
        the entire scan agrees with odometry.
        """
        is_silent = self._reckoning.is_silent or attempt.predicted.is_scan_alone
        return self._has_displaced or is_silent or self._is_fixed(static)

    def _is_fixed(self, static: Aligned) -> bool:
        """Whether the static returns alone fix the pose."""
        result = static.result
        return result.weakest_sigma_m <= self._degraded_sigma_m and result.used >= MIN_CONFIRMING

    def _is_seen_moving(self, aligned: Aligned, attempt: Attempt) -> bool:
        """Whether enough returns move to displace a match: of the returns, or without odometry of the
        information that they give about some direction. In a bare corridor few decide how far it goes along.
        """
        xy_base, pose = aligned.xy_base, aligned.result.pose
        is_dynamic = aligned.submap.on_dynamic(xy_base, attempt.normals, pose)
        if is_dynamic.mean() >= OUTLIER_SHARE:
            return True
        if not self._reckoning.is_silent:
            return False
        is_moving, _is_static = _classified(attempt, aligned.submap, xy_base, pose)
        return _is_decisive(is_moving, attempt)

    def _is_drifting(self, static: Aligned, attempt: Attempt) -> bool:
        """Whether matches of entire scans drift from the static path, farther than odometry errs.

        On unknown ground moving objects are not recognised by free space.
        """
        entire = self._align(attempt, attempt.prior.pose, static.submap, False)
        self._drift = self._drift @ static.pose.between(entire.pose)
        predicted = attempt.predicted
        step = predicted.increment or by_speed(predicted)
        excess = 1.0 - 1.0 / max(predicted.odometry_noise, 1.0)
        self._drift_m2 += excess * step.variance_m2
        self._drift_rad2 += excess * step.variance_rad2
        self._path_length_m += predicted.travel_m
        scale = USUAL.odometry_scale_sigma * self._path_length_m
        off_m = math.hypot(self._drift.x_m, self._drift.y_m) - math.sqrt(CHI2_999_OF_3 * self._drift_m2)
        off_rad = abs(self._drift.theta_rad) - math.sqrt(CHI2_999_OF_3 * self._drift_rad2)
        is_off = off_m > scale + MATCH_SIGMA_M or off_rad > scale + MATCH_SIGMA_RAD
        self._has_displaced |= is_off and self._is_fixed(static)
        return is_off


def _classified(
    attempt: Attempt, submap: Submap, xy_base: Matrix, pose: Matrix, moving_path_m: float = 0.0
) -> tuple[Mask, Mask]:
    """(N,) whether each return moves, and whether it lies near a static wall and does not move.

    It moves in a free or recently occupied cell off static walls, and where more returns of the same wall or
    object do than are static: the ends of a floor line lie on walls.

    moving_path_m   path by odometry since part of the scene began to move: what is as small as a person is
                    static only if it was there before; a laser alone may have nothing else to go by
    """
    is_static = np.isfinite(submap.static_residuals(xy_base, attempt.normals, pose))
    is_moving = submap.on_dynamic(xy_base, attempt.normals, pose) & ~is_static
    group = np.empty(len(xy_base), np.int64)
    sigma_m = np.full(len(xy_base), attempt.points.range_sigma_m)
    count = group_by_wall(attempt.points.xy_base, attempt.normals, sigma_m, group)
    moves = np.bincount(group, weights=is_moving) > np.bincount(group, weights=is_static)
    if moving_path_m > 0.0:
        lowest, highest = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
        np.minimum.at(lowest, group, xy_base)
        np.maximum.at(highest, group, xy_base)
        is_small = (np.hypot(*(highest - lowest).T) < ROUND_OBJECT_M)[group]
        before = submap.static_residuals(xy_base, attempt.normals, pose, STATIC_PATH_M + moving_path_m)
        is_static &= ~is_small | np.isfinite(before)
    is_moving |= moves[group]
    return is_moving, is_static & ~is_moving


def _is_decisive(some: Mask, attempt: Attempt) -> bool:
    """Whether some returns (N,), one object or more, give most of the information about a direction."""
    if some.sum() < BEAMS_TOGETHER:
        return False
    xy, (nx, ny, weight) = attempt.points.xy_base, attempt.normals.T
    rows = np.sqrt(weight)[:, None] * np.column_stack((nx, ny, xy[:, 0] * ny - xy[:, 1] * nx))
    shares = np.linalg.eigvals(np.linalg.pinv(rows.T @ rows) @ (rows[some].T @ rows[some]))
    return bool(shares.real.max() >= DECISIVE_SHARE)


def _is_on_wall(residual_m: Matrix) -> Mask:
    is_on: Mask = np.abs(np.nan_to_num(residual_m, nan=np.inf)) < ON_WALL_M
    return is_on


def _share_on_walls_only_at(one: Aligned, other: Aligned, attempt: Attempt) -> float:
    """Share of the returns that lie on walls at one of two poses and not at the other."""
    at_one, at_other = (
        _is_on_wall(of.submap.residuals(of.xy_base, attempt.normals, of.result.pose)) for of in (one, other)
    )
    return float((at_one & ~at_other).mean())


def _is_witnessed(predicted: Prediction) -> bool:
    """Whether odometry measured the step from a recent scan."""
    return predicted.increment is not None and predicted.elapsed_s <= PAUSE_NS * 1e-9


def _prior_at(conflict: Conflict, attempt: Attempt) -> Prior:
    pose = conflict.pose
    at = np.array(pose)
    return attempt.prior._replace(pose=at, covariance=conflict.covariance)
