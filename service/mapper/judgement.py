"""Accepts or rejects a match: one rule for the matchers of all profiles."""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import Field

from drivers.section import Section
from service.estimator.motion import Prediction
from service.geometry.se2 import SE2
from service.mapper.components import Match, Points
from service.outputs import NO_REASON, Reason, ReasonId, State

MIN_RETURNS = 5  # fewer are not matched: three unknowns, and two to check them
MIN_CONFIRMING = 20  # returns of a scan for `ok`
MAX_SIGMA_M, MAX_SIGMA_RAD = 0.15, math.radians(3.0)  # `ok`: sigma of the pose against the map
# `ok`: sigma of the pose in the map, with the drift since known ground was last seen
MAX_DRIFT_M, MAX_DRIFT_RAD = 0.3, math.radians(10.0)
LOST_SIGMA_M, LOST_SIGMA_RAD = 0.75, 0.35  # above it lost: several poses may match
TIGHT_SIGMA_M, TIGHT_SIGMA_RAD = 0.5, 0.4  # a prediction within it carries the pose onto new ground
# Least share on walls of the returns on known ground. Over 8 recorded and 10 simulated drives it is 0.90 to
# 1.00 at a right pose; people nearby lower it.
MIN_AGREEMENT = 0.5
MIN_AGREEMENT_FAR = 0.85  # where the match is far from the prediction
MIN_KNOWN = 0.02  # share of the returns on the map, and at least MIN_RETURNS: fewer are no evidence
CHANCE_SIGMAS = 2.0  # tolerance for contradicting returns, of their binomial spread
JUMP_CHI2 = 27.9  # 99.999 % of three degrees of freedom: gate of a match against the prediction, of a loop
GAP_S = 2.5  # without a scan: a loose prediction is a gap of the path; without a scan with returns: lost
UNKNOWN_SIGMA_M, UNKNOWN_SIGMA_RAD = 100.0, math.pi  # a larger sigma is reported as not known
UNKNOWN_PLACE = np.diag([UNKNOWN_SIGMA_M, UNKNOWN_SIGMA_M, UNKNOWN_SIGMA_RAD]) ** 2  # m^2, rad^2
MAX_UNMEASURED_S = 4.0  # without a measurement of motion: long enough to carry the vehicle elsewhere
RECOVERY_HINT = "Drive back to mapped ground, or set the pose"  # what to do when the vehicle is lost
# Reasons about one scan on the map that do not name the laser themselves.
OF_SCAN: frozenset[ReasonId] = frozenset(
    (
        *("contradicted", "off_map", "little_on_map", "new_ground", "few_confirming", "little_in_common"),
        *("unconfirmed", "prediction_stands", "new_map", "pose_uncertain", "open_direction", "scene_moves"),
    )
)


class JudgementConfig(Section):
    """Thresholds of acceptance; part of the settings of every matcher."""

    lost_ratio: float = Field(default=0.30, ge=0.0, le=1.0)  # of the returns on the map: below, lost
    degraded_ratio: float = Field(default=0.45, ge=0.0, le=1.0)  # below, degraded
    degraded_sigma_m: float = Field(default=0.10, gt=0.0)  # above it the open direction is reported


class Evidence(NamedTuple):
    """How a scan lies on a map.

    used        number of returns evaluated
    on_map      of them, on walls of the map
    in_free     of them, in its free space; the rest is on unknown ground
    sigma       (m, rad) of the pose against the map, prediction and scan fused; worst direction
    prior       (m, rad) of the prediction alone
    is_measured wheels or an IMU measured the motion since the last scan
    is_far      the match is outside the gate of the prediction, or the prediction is loose, or odometry was
                missing for longer than GAP_S
    weakest     (m, rad) sigma of the position by the scan alone in its worst direction, and that direction
                in base axes
    open_m      how far the vehicle can have come since a scan fixed its position, m
    behind      returns clearly behind walls of the map, on unknown ground; None: not counted
    is_in_doubt  a scan has contradicted this map since the last match: then returns on unknown ground are no
                evidence of new ground, and those behind walls count as contradictions
    """

    used: int
    on_map: float
    in_free: float
    sigma: tuple[float, float]
    prior: tuple[float, float]
    is_measured: bool
    is_far: bool
    weakest: tuple[float, float] = (0.0, 0.0)
    behind: float | None = None
    is_in_doubt: bool = False
    open_m: float = math.inf

    @property
    def inlier_ratio(self) -> float:
        return self.on_map / self.used if self.used else 0.0


def sigmas_of(covariance: npt.NDArray[np.float64]) -> tuple[float, float]:
    """(m in the worst direction, rad) of a (3, 3) covariance of x, y, theta."""
    (a, b, _), (_, d, _), (_, _, turn) = covariance.tolist()
    largest = 0.5 * (a + d) + math.hypot(0.5 * (a - d), b)
    return math.sqrt(max(largest, 0.0)), math.sqrt(max(turn, 0.0))


def weakest_of(covariance: npt.NDArray[np.float64]) -> tuple[float, float]:
    """(m, rad) sigma in the worst direction of a (3, 3) covariance of x, y, theta, and that direction."""
    variances, axes = np.linalg.eigh(covariance[:2, :2])
    return math.sqrt(max(float(variances[1]), 0.0)), math.atan2(axes[1, 1], axes[0, 1])


def is_loose(sigmas: tuple[float, float]) -> bool:
    """Whether a prediction with sigmas (m, rad) is too uncertain to constrain the match."""
    return sigmas[0] > TIGHT_SIGMA_M or sigmas[1] > TIGHT_SIGMA_RAD


def chi2_between(predicted: SE2, pose: SE2, covariance: npt.NDArray[np.float64]) -> float:
    """Squared Mahalanobis distance of a pose to the prediction; (3, 3) covariance in base axes.

    Raises ZeroDivisionError if the covariance is singular.
    """
    away = predicted.between(pose)
    (xx, _, _), (yx, yy, _), (tx, ty, tt) = covariance.tolist()  # written out: np.linalg takes 10 us per call
    y_of_x, t_of_x = yx / xx, tx / xx
    y_left, ty_left = yy - y_of_x * yx, ty - t_of_x * yx
    t_of_y = ty_left / y_left
    t_left = tt - t_of_x * tx - t_of_y * ty_left
    y = away.y_m - y_of_x * away.x_m
    t = away.theta_rad - t_of_x * away.x_m - t_of_y * y
    return float(away.x_m * away.x_m / xx + y * y / y_left + t * t / t_left)


def is_motion_unmeasured(predicted: Prediction) -> bool:
    """Whether the motion since the last scan was not measured, so that the vehicle may be anywhere."""
    return predicted.pause_s > MAX_UNMEASURED_S or predicted.is_unconfirmed_stop


def begun(points: Points, predicted: Prediction) -> Match:
    """Match of the first scan: the map begins at the predicted pose."""
    return Match(predicted, points, 1.0)


def unmatched(
    points: Points,
    predicted: Prediction,
    reason: Reason,
    inlier_ratio: float = 0.0,
    is_contradicted: bool = True,
) -> Match:
    """Match of a lost scan: the pose is the prediction."""
    return Match(predicted, points, inlier_ratio, "lost", reason, is_contradicted=is_contradicted)


def of_laser(sensor: str, reason: Reason) -> Reason:
    """The reason, prefixed with the laser's name if it is about one scan on the map."""
    return reason.reworded(f"{sensor}: {reason}") if reason.id in OF_SCAN else reason


def of_standstill(reason: Reason) -> Reason:
    """The reason of a match while odometry has never moved."""
    if reason.id not in ("pose_uncertain", "open_direction"):
        return reason
    return reason.reworded(
        f"{reason}. Odometry has not moved yet, as one with a dead encoder; it counts once the vehicle drives"
    )


def too_few(points: Points) -> Reason:
    """Reason if a scan has too few returns to be matched, else NO_REASON."""
    if len(points.xy_base) >= MIN_RETURNS:
        return NO_REASON
    ranges = points.scan.range_m[np.isfinite(points.scan.range_m)]
    if len(ranges) >= MIN_RETURNS:
        return Reason(
            "few_returns",
            f"{points.scan.sensor}: {len(points.xy_base)} of {len(ranges)} returns lie within the ranges "
            f"that are mapped (at least {MIN_RETURNS}), half of them beyond {np.median(ranges):.4g} m; "
            "are ranges in m?",
        )
    return Reason(
        "few_returns",
        f"{points.scan.sensor}: {len(points.xy_base)} of {len(points.scan.range_m)} beams returned "
        f"(at least {MIN_RETURNS}); is the window covered, or is there nothing in range?",
    )


def judge_blank(few: Reason, prior: tuple[float, float], blank_s: float) -> tuple[State, Reason]:
    """State and reason at a scan with too few returns, where the pose was known before.

    Such a scan neither measures nor contradicts: the pose is the prediction, with its covariance.

    few      the reason that `too_few` returns
    prior    (m, rad) sigma of the prediction against the map
    blank_s  since the newest scan with enough returns
    """
    state: State = "lost" if is_loose(prior) or blank_s > GAP_S else "degraded"
    most = TIGHT_SIGMA_M, TIGHT_SIGMA_RAD
    words = f"{few} The pose follows the prediction for {blank_s:.2f} s, {_uncertain(prior, most)}"
    return state, few.reworded(words)


def judge(evidence: Evidence, limits: JudgementConfig) -> tuple[State, Reason]:
    """State and reason of a match; NO_REASON if ok. "lost": the match is rejected.

    Few returns on the map have two causes. On new ground the others end on unknown ground; then a good
    prediction carries the pose. At a wrong pose they end in free space, which contradicts any prediction.
    """
    ratio = evidence.inlier_ratio
    # On new ground the pose is the prediction; a match far from it needs more evidence.
    is_carried = evidence.is_measured and not evidence.is_far and not is_loose(evidence.prior)
    least_on_map = max(MIN_KNOWN * evidence.used, MIN_RETURNS)
    can_contradict = evidence.behind is not None and not evidence.is_in_doubt
    if is_carried and can_contradict and evidence.on_map < least_on_map:
        return _on_unknown_ground(evidence)
    known = evidence.on_map + evidence.in_free
    if evidence.is_in_doubt:
        known += evidence.behind or 0.0
    agreement = evidence.on_map / known if known else 0.0
    least_agreement = MIN_AGREEMENT_FAR if evidence.is_far else MIN_AGREEMENT
    if known and agreement < least_agreement:
        expected = f"of those on known ground {agreement:.0%} on its walls, expected {least_agreement:.0%}"
        return "lost", _contradicted(evidence, expected)
    least = limits.degraded_ratio if evidence.is_far else limits.lost_ratio
    if ratio < least and not (is_carried and ratio >= MIN_KNOWN):
        words = (
            f"{_on_map(evidence)} (at least {least:.0%}); the pose follows the prediction. {RECOVERY_HINT}"
        )
        return "lost", Reason("off_map", words)
    # Enough returns on the map confirm the pose, and the others lie on new ground.
    is_confirmed = can_contradict and ratio >= limits.lost_ratio and evidence.on_map >= MIN_CONFIRMING
    is_confirmed = is_confirmed and not is_contradicted(evidence)
    # Along a direction that walls leave open odometry may be uncertain, and its sigma includes that. The scan
    # contradicts nothing there, and a detached segment would be no better localised.
    is_open = not evidence.is_far and evidence.weakest[0] > limits.degraded_sigma_m
    if evidence.sigma[1] > LOST_SIGMA_RAD or (
        evidence.sigma[0] > LOST_SIGMA_M and not (is_open and is_confirmed)
    ):
        most = LOST_SIGMA_M, LOST_SIGMA_RAD
        return "lost", _pose_uncertain(evidence, most)
    if ratio < limits.degraded_ratio and not (is_carried and is_confirmed):
        return "degraded", Reason(
            "little_on_map",
            f"{_on_map(evidence)} (expected {limits.degraded_ratio:.0%}): unmapped ground, or a place that "
            "has changed much. Drive slowly until more of it is mapped",
        )
    return _confidence_on_map(evidence, limits)


def _confidence_on_map(evidence: Evidence, limits: JudgementConfig) -> tuple[State, Reason]:
    """State and reason of a scan that lies on the map, by what it leaves uncertain."""
    if evidence.sigma[0] > MAX_SIGMA_M or evidence.sigma[1] > MAX_SIGMA_RAD:
        most = MAX_SIGMA_M, MAX_SIGMA_RAD
        return "degraded", _pose_uncertain(evidence, most)
    if evidence.used < MIN_CONFIRMING:
        return "degraded", Reason(
            "few_confirming",
            f"{evidence.used} returns (expected at least {MIN_CONFIRMING}) confirm no place; "
            "is the window covered, or is there little in range?",
        )
    sigma_m, direction_rad = evidence.weakest
    if sigma_m > limits.degraded_sigma_m and evidence.open_m > MAX_SIGMA_M:
        sigma = f"{sigma_m:.2f} m" if sigma_m <= UNKNOWN_SIGMA_M else "not known"
        return "degraded", Reason(
            "open_direction",
            "the scan does not fix the position along the direction "
            f"{round(math.degrees(direction_rad)) % 180} deg from the vehicle's heading (sigma {sigma}, "
            f"expected at most {limits.degraded_sigma_m:g} m); there the pose follows the prediction. "
            "Odometry, or a laser that sees a wall across it, would fix it",
        )
    return "ok", NO_REASON


def _on_unknown_ground(evidence: Evidence) -> tuple[State, Reason]:
    """State and reason of a scan with no return on the map and a good prediction: new ground, unless too many
    returns lie in free space or behind walls that should be visible.
    """
    if is_contradicted(evidence):
        return "lost", _contradicted(evidence, f"expected at most {1.0 - MIN_AGREEMENT_FAR:.0%} there")
    words = (
        f"{_on_map(evidence)} (expected {MIN_KNOWN:.0%}): unmapped ground; the pose follows the prediction "
        "onto it. Keep a part of the map in view"
    )
    return "degraded", Reason("new_ground", words)


def is_contradicted(evidence: Evidence) -> bool:
    """Whether more returns than chance explains lie in free space or behind walls of the map."""
    used, usual = evidence.used, 1.0 - MIN_AGREEMENT_FAR
    chance = CHANCE_SIGMAS * math.sqrt(usual * (1.0 - usual) * used)
    return evidence.in_free + (evidence.behind or 0.0) > usual * used + chance


def drift_of(covariance: npt.NDArray[np.float64]) -> Reason:
    """Reason if a pose with a covariance (3, 3) in the map is too uncertain to be `ok`, else NO_REASON."""
    sigma_m, sigma_rad = sigmas_of(covariance)
    if sigma_m <= MAX_DRIFT_M and sigma_rad <= MAX_DRIFT_RAD:
        return NO_REASON
    return Reason(
        "drift",
        "the pose has drifted without loop closures: in the map it is "
        f"{_uncertain((sigma_m, sigma_rad), (MAX_DRIFT_M, MAX_DRIFT_RAD))}; drive past a place that is "
        "mapped already",
    )


def _pose_uncertain(evidence: Evidence, most: tuple[float, float]) -> Reason:
    words = f"the pose on the map is {_uncertain(evidence.sigma, most)}"
    return Reason("pose_uncertain", f"{words}. Drive where walls of several directions are in view")


def _uncertain(sigmas: tuple[float, float], most: tuple[float, float]) -> str:
    """Text for sigmas (m, rad) and their limits; "not known" if they are too large to mean anything."""
    (sigma_m, sigma_rad), (most_m, most_rad) = sigmas, most
    if not (sigma_m <= UNKNOWN_SIGMA_M and sigma_rad <= UNKNOWN_SIGMA_RAD):
        return "not known"
    return (
        f"uncertain by {sigma_m:.2f} m and {math.degrees(sigma_rad):.1f} deg (sigma, expected at most "
        f"{most_m} m and {math.degrees(most_rad):.0f} deg)"
    )


def _contradicted(evidence: Evidence, expected: str) -> Reason:
    used = max(evidence.used, 1)
    behind = "" if evidence.behind is None else f", {evidence.behind / used:.0%} behind its walls"
    return Reason(
        "contradicted",
        f"{_on_map(evidence)}, {evidence.in_free / used:.0%} in its free space{behind} ({expected}): "
        f"another place, or one that has changed much; the pose follows the prediction. {RECOVERY_HINT}",
    )


def _on_map(evidence: Evidence) -> str:
    return f"{evidence.inlier_ratio:.0%} of {evidence.used} returns lie on the map"
