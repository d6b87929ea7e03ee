"""Scan-to-scan ICP: the start of a search, or a matcher by itself."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import Field

from drivers.section import Section
from service.estimator.motion import Measurement, Prediction
from service.geometry.se2 import SE2
from service.kernels.deskew import deskew_points
from service.kernels.icp import icp_point_to_point
from service.mapper.components import Match, Points
from service.mapper.judgement import JudgementConfig, begun, too_few, unmatched
from service.mapper.matchers.covariances import diagonal, inverse
from service.mapper.matchers.judged import Aligned, judged_alone
from service.mapper.papers.imle.patch_map import PatchMap
from service.outputs import Reason

Array = npt.NDArray[np.float64]


class IcpConfig(Section):
    """Pairing, and convergence."""

    pair_m: float = Field(default=1.0, gt=0.0)  # largest distance of a pair
    points: int = Field(default=180, ge=20)  # of the newer scan that are paired, evenly chosen
    iterations: int = Field(default=50, ge=1, le=1000)
    settled: float = Field(default=1e-3, gt=0.0)  # m and rad: a smaller step is the last
    least_inlier_ratio: float = Field(default=0.5, ge=0.0, le=1.0)  # share of the points with a partner


class Step(NamedTuple):
    """Pose of the base by the previous scan.

    rms_m   root mean square distance of the pairs
    share   of the points with a partner
    """

    pose: SE2
    rms_m: float
    share: float


class ScanIcp:
    """ICP against the previous scan."""

    def __init__(self, config: IcpConfig) -> None:
        self._config = config
        self._last: tuple[Array, SE2] | None = None

    def step(self, points: Points, predicted: Prediction) -> Step | None:
        """The step by ICP; None without a previous scan, or with too few pairs."""
        if self._last is None:
            return None
        older, pose = self._last
        guess = pose.between(predicted.pose_odom_base)
        config = self._config
        stride = max(1, round(len(points.xy_base) / config.points))
        newer = np.ascontiguousarray(points.xy_base[::stride])
        result = icp_point_to_point(
            newer, older, np.array(guess), config.pair_m, config.iterations, config.settled
        )
        if result.paired < max(config.least_inlier_ratio * len(newer), 3):
            return None
        x_m, y_m, theta_rad = result.step.tolist()
        return Step(pose @ SE2(x_m, y_m, theta_rad), float(result.rms_m), result.paired / len(newer))

    def remember(self, match: Match) -> None:
        self._last = (match.points.xy_base, match.motion.pose_odom_base)


def deskewed(points: Points, predicted: Prediction, pose: SE2) -> Points:
    """The points deskewed with the twist at a matched pose."""
    xy_base = np.empty_like(points.xy_base)
    deskew_points(points.xy_raw, points.beam_time_s, np.array(predicted.twist_at(pose)), xy_base)
    return points._replace(xy_base=xy_base)


class IcpScanToScanConfig(IcpConfig, JudgementConfig):
    """Plain ICP: all points, pairs at any distance."""

    pair_m: float = Field(default=1000.0, gt=0.0)
    points: int = Field(default=100_000, ge=20)
    settled: float = Field(default=1e-4, gt=0.0)
    position_sigma_m: float = Field(default=0.02, gt=0.0)  # of a step
    heading_sigma_rad: float = Field(default=0.01, gt=0.0)


class IcpScanToScan:
    """Matcher[PatchMap] that does not use the map: a reference for the searches.

    The prediction is only the initial pose, so the result is already final.
    """

    def __init__(self, config: IcpScanToScanConfig) -> None:
        self._config = config
        self._icp = ScanIcp(config)
        self._covariance = diagonal(config.position_sigma_m, config.heading_sigma_rad)
        self._information = inverse(self._covariance)

    def match(self, points: Points, predicted: Prediction, local_map: PatchMap) -> Match:
        if reason := too_few(points):
            return unmatched(points, predicted, reason)
        step = self._icp.step(points, predicted)
        if local_map.is_empty:
            match = begun(points, predicted)
        elif step is None:
            reason = Reason(
                "little_in_common",
                f"less than {self._config.least_inlier_ratio:.0%} of the returns lie near those of the scan "
                "before; the pose follows the prediction. Drive slower, or choose a profile that matches to "
                "a map",
            )
            match = unmatched(points, predicted, reason)
        else:
            measured = Measurement(step.pose, self._covariance, self._information)
            aligned = Aligned(measured, deskewed(points, predicted, step.pose))
            match = judged_alone(aligned, predicted, round(step.share * len(points.xy_base)), self._config)
        self._icp.remember(match)
        return match

    compare = match  # its state is independent of the laser
