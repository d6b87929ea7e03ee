"""People near the laser pull a match along with them: it is compared with that of the walls alone, [38].

Hundreds of returns from a person weigh as much as a wall farther away. Objects as narrow as a person that
have not been seen over STATIC_PATH_M of the path may move, walls do not. An estimate from all returns is the
better one if they stand still; if not, it differs from that of the walls by more than their covariance
explains (Hausman, Specification Tests in Econometrics, Econometrica 46, 1978).
"""

import math
from collections.abc import Callable

import numpy as np

from service.geometry.chi2 import CHI2_99_OF_3, CHI2_999_OF_3
from service.mapper.judgement import MIN_CONFIRMING
from service.mapper.scan_match.attempt import Aligned, Attempt, Matrix, chi2_of
from service.mapper.scan_match.submaps import Submap

# Smaller pulls are not worth a second match; of objects that stand still they are 1 to 3 mm in offices.
MIN_PULL_M, MIN_PULL_RAD = 0.005, 0.003
# Error of two matches of one scan with other returns, by the cells of the map.
CELL_COVARIANCE = np.diag([0.002, 0.002, 0.0005]) ** 2  # m, m, rad


class SmallObjects:
    """Matches without small objects where these have moved."""

    def __init__(
        self, align: Callable[[Attempt, Matrix, Submap, bool], Aligned], degraded_sigma_m: float
    ) -> None:
        self._align = align
        self._degraded_sigma_m = degraded_sigma_m

    def without(self, aligned: Aligned, attempt: Attempt) -> Aligned:
        """The match, or that of the walls alone, where these fix the pose and small objects pull it away."""
        normals, xy_base, pose = attempt.normals, aligned.xy_base, aligned.result.pose
        variance_m2 = attempt.points.range_sigma_m**2
        information: Matrix = np.asarray(np.linalg.inv(attempt.prior.covariance), np.float64)
        arguments = pose, variance_m2, information
        pull, is_small = aligned.submap.pull_of_small_objects(xy_base, normals, *arguments)
        if not _is_far(pull):
            return aligned
        normals = normals.copy()
        normals[np.isfinite(aligned.submap.static_residuals(xy_base, normals, pose)) & is_small, 2] = 0.0
        pull, may_move = aligned.submap.pull_of_small_objects(xy_base, normals, *arguments)
        if not _is_far(pull):
            return aligned
        alone = attempt._replace(normals=np.where(may_move[:, None], 0.0, attempt.normals))
        walls = self._align(alone, attempt.prior.pose, aligned.submap, False)
        if not self._is_pulled_from(walls, aligned, attempt):
            return aligned
        # Where walls have two optima, the one near the prediction may be the worse: odometry may be wrong.
        nearer = self._align(alone, pose, aligned.submap, False)
        best = max(walls, nearer, key=lambda one: one.result.share)
        return best if self._is_pulled_from(best, aligned, attempt) else aligned

    def _is_pulled_from(self, walls: Aligned, aligned: Aligned, attempt: Attempt) -> bool:
        """Whether a match of the walls fixes the pose and excludes that of the entire scan."""
        result = walls.result
        if walls.state == "lost" or result.weakest_sigma_m > self._degraded_sigma_m:
            return False
        if chi2_of(walls.pose, attempt.prior) > max(chi2_of(aligned.pose, attempt.prior), CHI2_99_OF_3):
            return False  # less likely by the prediction
        at_walls = attempt.prior._replace(pose=result.pose, covariance=result.covariance + CELL_COVARIANCE)
        return result.used >= MIN_CONFIRMING and chi2_of(aligned.pose, at_walls) > CHI2_999_OF_3


def _is_far(pull: Matrix) -> bool:
    """(3,) m, m, rad."""
    x_m, y_m, turn_rad = pull.tolist()
    return math.hypot(x_m, y_m) > MIN_PULL_M or abs(turn_rad) > MIN_PULL_RAD
