"""Whether a scan was matched where the vehicle is: one rule for the matchers of all profiles."""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.fusion.motion import Prediction
from service.outputs import State

MOST_SIGMA_M, MOST_SIGMA_RAD = 0.15, math.radians(3.0)  # `ok`: the pose against the map is known so well
LOST_SIGMA_M, LOST_SIGMA_RAD = 0.75, 0.35  # worse: lost, for a match within so much may be any of several
TIGHT_SIGMA_M, TIGHT_SIGMA_RAD = 0.5, 0.4  # a prediction so good carries the pose onto new ground
# Share of the returns, of those on ground that the map knows, that lie on its walls: over 8 recorded and 10
# simulated drives it is 0.90 to 1.00 where the pose is right; people close by lower it.
LEAST_AGREEMENT = 0.5
LEAST_AGREEMENT_FAR = 0.85  # where the match is not where the prediction was
LEAST_KNOWN = 0.02  # share of the returns that must lie on the map even on new ground


@dataclass(frozen=True, slots=True)
class Evidence:
    """How a scan lies on a map.

    used        returns asked
    on_map      of them, on walls of the map
    in_free     of them, where the map knows that nothing stands; the rest is on ground that it does not know
    sigma       (m, rad) of the pose against the map, prediction and scan together; the position's worst
    prior       (m, rad) of the prediction alone
    is_measured odometry measured the motion since the last scan
    is_far      the match is farther from the prediction than chance explains, or the prediction says little
    """

    used: int
    on_map: float
    in_free: float
    sigma: tuple[float, float]
    prior: tuple[float, float]
    is_measured: bool
    is_far: bool

    @property
    def inlier_ratio(self) -> float:
        return self.on_map / self.used if self.used else 0.0


@dataclass(frozen=True, slots=True)
class Ratios:
    """Of the returns on the map: below `lost` a match is none, below `degraded` it is doubtful."""

    lost: float
    degraded: float


def sigmas_of(covariance: npt.NDArray[np.float64]) -> tuple[float, float]:
    """(m of the worst direction, rad) of a (3, 3) covariance of x, y, theta."""
    a, b, d = covariance[0, 0], covariance[0, 1], covariance[1, 1]
    largest = 0.5 * (a + d) + math.hypot(0.5 * (a - d), b)
    return math.sqrt(max(float(largest), 0.0)), math.sqrt(max(float(covariance[2, 2]), 0.0))


def prior_of(predicted: Prediction) -> tuple[float, float]:
    return sigmas_of(predicted.local_covariance)


def judge(evidence: Evidence, ratios: Ratios) -> tuple[State, str]:
    """State and its reason, "" where it is ok. "lost": the match is not to be believed.

    A scan may lie on the map in small part for two reasons. On new ground its returns lie where the map knows
    nothing; then a prediction that is good carries the pose. At a wrong pose they lie where the map knows
    that nothing stands: that contradicts, however good the prediction was.
    """
    ratio = evidence.inlier_ratio
    known = evidence.on_map + evidence.in_free
    agreement = evidence.on_map / known if known else 0.0
    is_tight = evidence.prior[0] <= TIGHT_SIGMA_M and evidence.prior[1] <= TIGHT_SIGMA_RAD
    on_map = f"{ratio:.0%} of {evidence.used} returns lie on the map"
    in_free = f"{evidence.in_free / max(evidence.used, 1):.0%}"
    if known and agreement < (LEAST_AGREEMENT_FAR if evidence.is_far else LEAST_AGREEMENT):
        return "lost", (
            f"{on_map} and {in_free} where it knows that nothing stands: "
            "this is another place, or much has changed; the pose follows the prediction"
        )
    if ratio < (ratios.degraded if evidence.is_far else ratios.lost) and not (
        is_tight and evidence.is_measured and ratio >= LEAST_KNOWN
    ):
        least = ratios.degraded if evidence.is_far else ratios.lost
        return "lost", f"{on_map} (at least {least:.0%}); the pose follows the prediction"
    if evidence.sigma[0] > LOST_SIGMA_M or evidence.sigma[1] > LOST_SIGMA_RAD:
        return "lost", (
            f"the position on the map is known to {evidence.sigma[0]:.2f} m and "
            f"{math.degrees(evidence.sigma[1]):.0f} deg only (at most {LOST_SIGMA_M} m, "
            f"{math.degrees(LOST_SIGMA_RAD):.0f} deg)"
        )
    if ratio < ratios.degraded:
        return "degraded", f"{on_map} (expected {ratios.degraded:.0%}): new ground, or much has changed"
    if evidence.sigma[0] > MOST_SIGMA_M or evidence.sigma[1] > MOST_SIGMA_RAD:
        return "degraded", (
            f"the position on the map is known to {evidence.sigma[0]:.2f} m and "
            f"{math.degrees(evidence.sigma[1]):.1f} deg (expected {MOST_SIGMA_M} m, "
            f"{math.degrees(MOST_SIGMA_RAD):.0f} deg)"
        )
    return "ok", ""
