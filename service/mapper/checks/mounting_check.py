"""Check of a laser's mounting against a map built by other lasers.

A mounting that is wrong by some degrees is invisible in the map of that laser alone, but it damages the map
of several. A laser that joins others is therefore aligned with their map, without effect on pose and map,
until its offset from the configured mounting is known. The offset is a least-squares estimate over scans,
compared with MOUNTING_TOLERANCE. In a young map a search may place a scan wrongly, turned by 90 degrees in a
room: scans that contradict the others weigh less, as in odometry_mounting. A corridor is symmetric: whether a
laser is turned by 180 degrees is decided by contradictions with known ground.

A laser within the tolerance is mapped. Where its scans right after those of other lasers contradict a
calibrated mounting, it is corrected by what they measure; docs/estimator.md, [36].
"""

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from service.estimator.motion import Matrix, Measurement, Prediction
from service.geometry.chi2 import CHI2_999_OF_3, CHI2_MEDIAN_OF_3
from service.geometry.se2 import SE2
from service.kernels.step_offset import ROBUST_CHI2
from service.mapper.checks.stamp_check import BATCH, SCANS_WITH_SAME_ERRORS
from service.outputs import NO_REASON, Reason

MOUNTING_TOLERANCE = np.diag([0.03, 0.03, math.radians(0.5)]) ** 2  # m, m, rad: of mountings measured by hand
CALIBRATED = np.diag([0.001, 0.001, math.radians(0.02)]) ** 2  # of mountings by `corridor calibrate`
WEAK = 1e-3 * np.linalg.inv(MOUNTING_TOLERANCE)  # information that keeps unobservable directions invertible
SEARCHED = np.diag([0.10, 0.10, math.radians(6.0)]) ** 2  # sigmas of the search for its scans meanwhile
MIN_ADVANTAGE = 0.1  # of one orientation over the other, in agreement with known ground
KNOWN_RAD, KNOWN_M = math.radians(0.3), 0.02  # largest sigma of heading and of position in its best direction


class MountingCheck:
    """Check of one laser. `is_right` until there is a map to compare it with; see `begin`.

    A laser with a `fault` is not mapped, even if it is the only one left: it would damage the map.
    """

    def __init__(self) -> None:
        self.is_right = True
        self.fault = NO_REASON  # the offset, once it is known
        self._covariance: Matrix | None = None  # (3, 3) of `applied`, base axes; None: nothing is corrected
        self.applied = SE2()  # correction of the configured mounting, base axes
        self._is_further = False  # another laser began the map
        self._advantage = 0.0  # sum over batches
        self._offset = np.zeros(3)  # of the sensor from its configured mounting, base axes: m, m, rad
        self._begin_batch()

    def begin(self) -> None:
        """Start the comparison: another laser has begun the map."""
        self.is_right, self._is_further = False, True

    def refine(self, predicted: Prediction, measured: Measurement) -> bool:
        """Add a scan right after one of another laser; whether `applied` was corrected."""
        self._add(*_scan_alone(measured, predicted, predicted.local_covariance))
        if len(self._weighed) < BATCH:
            return False
        is_corrected = self._refine()
        self._begin_batch()
        return is_corrected

    def search_prior(self, predicted: Prediction, late_s: float) -> Prediction:
        """Pose and covariance of the search for its scan on the map. late_s: of its stamps."""
        forward_mps, left_mps, turn_radps = predicted.twist_base
        since = SE2.exp(late_s * forward_mps, late_s * left_mps, late_s * turn_radps)
        measured_at = predicted.pose_odom_base @ since.inverse()
        return replace(
            predicted.with_added_covariance(SEARCHED),
            pose_odom_base=measured_at @ SE2.exp(*self._offset.tolist()),
        )

    def add(self, prior: Prediction, measured: Measurement, advantage: float | None = None) -> None:
        """Add a scan aligned with the map from `search_prior`. advantage: as in Match."""
        self._add(*_scan_alone(measured, prior, np.zeros((3, 3))))
        self._advantages.append(MIN_ADVANTAGE if advantage is None else advantage)
        if len(self._weighed) == BATCH:
            self._judge()
            self._begin_batch()

    def miss(self) -> None:
        """Count a scan that matched nowhere in the search window."""
        self._missed += 1
        if self._missed >= BATCH:
            self._begin_batch()
            self.fault = Reason(
                "laser_mounting",
                "does not fit the map of the other lasers, even after a search around its configured "
                "mounting; it is not mapped. Are its mounting and theirs as configured?",
            )

    def _add(self, information: Matrix, weighed: Matrix) -> None:
        self._information.append(information / SCANS_WITH_SAME_ERRORS)
        self._weighed.append(weighed / SCANS_WITH_SAME_ERRORS)

    def _batch(self) -> tuple[Matrix, Matrix]:
        return np.array(self._information), np.array(self._weighed)

    def _begin_batch(self) -> None:
        self._information: list[Matrix] = []  # (3, 3) of each scan
        self._weighed: list[Matrix] = []  # (3,) information times offset
        self._advantages: list[float] = []
        self._missed = 0

    def _refine(self) -> bool:
        """Correct the mounting by a batch, within the tolerance; whether it was corrected."""
        batch = self._batch()
        off, covariance = _robust_mean(*batch, WEAK)
        if _chi2(np.array(self.applied.log()) + off, covariance + MOUNTING_TOLERANCE) > CHI2_999_OF_3:
            self._doubt(off)
            return False
        if self._covariance is None:
            if _chi2(off, covariance + CALIBRATED) <= CHI2_999_OF_3:
                return False
            self._covariance = MOUNTING_TOLERANCE
        prior = np.asarray(np.linalg.inv(self._covariance), np.float64)
        correction, self._covariance = _robust_mean(*batch, prior)
        self._correct(correction)
        return True

    def _correct(self, by: Matrix) -> None:
        """by   (3,) m, m, rad: twist times duration"""
        self.applied = SE2.exp(*(self.applied.log() + by).tolist())

    def _doubt(self, offset: Matrix) -> None:
        """Compare a further laser with the map again: it was knocked, or the first one was."""
        if self._is_further:
            self.is_right, self._advantage, self._offset = False, 0.0, offset

    def _judge(self) -> None:
        correction, covariance = _robust_mean(*self._batch(), WEAK)
        self._offset = self._offset + _bounded(correction, covariance)
        sigma_m = math.sqrt(float(np.linalg.eigvalsh(covariance[:2, :2])[0]))
        if math.sqrt(covariance[2, 2]) > KNOWN_RAD or sigma_m > KNOWN_M:
            return
        self._advantage += float(np.mean(self._advantages))
        if abs(self._advantage) < MIN_ADVANTAGE:  # ambiguous between the two orientations so far
            return
        chi2 = _chi2(self._offset, covariance + MOUNTING_TOLERANCE)
        self.is_right = self._advantage > 0.0 and chi2 <= CHI2_999_OF_3
        self.fault = NO_REASON if self.is_right else self._fault_of()

    def _fault_of(self) -> Reason:
        x_m, y_m, turn_rad = self._offset.tolist()
        off = (
            f"is off its configured mounting by {math.degrees(turn_rad):+.1f} deg, {x_m:+.2f} m ahead and "
            f"{y_m:+.2f} m left"
        )
        if self._advantage < 0.0:
            off = "fits better if it is turned by 180 deg against its configured mounting"
        words = f"{off}, measured on the map of the other lasers; it is not mapped. "
        return Reason("laser_mounting", words + "Measure its mounting and theirs, and correct the config")


def centre(checks: Iterable[MountingCheck]) -> None:
    """Shift the corrections of all mapped lasers to a mean of 0: no mounting is better than another."""
    mapped = [check for check in checks if check.is_right]
    mean = np.mean([check.applied.log() for check in mapped], axis=0)
    for check in mapped:
        check._correct(-mean)


def _chi2(offset: Matrix, covariance: Matrix) -> float:
    return float(offset @ np.linalg.solve(covariance, offset))


def _scan_alone(measured: Measurement, predicted: Prediction, added: Matrix) -> tuple[Matrix, Matrix]:
    """Information J = (I^-1 + D)^-1 of the scan alone, (3, 3), and J e, (3,).

    added   (3, 3) covariance D, base axes

    e is the offset of the scan alone from the prediction. The joint pose is C I e from it, with its
    covariance C; so no direction needs to be known.
    """
    off = predicted.pose_odom_base.between(measured.pose_odom_base).log()
    kept = np.linalg.inv(np.eye(3) + measured.information @ added)
    joint = np.linalg.inv(measured.covariance) if measured.is_joined else measured.information
    return kept @ measured.information, kept @ joint @ off


def _robust_mean(information: Matrix, weighed: Matrix, prior: Matrix) -> tuple[Matrix, Matrix]:
    """(3,) offset m, m, rad and its covariance (3, 3).

    information   (K, 3, 3)   of each scan, singular where a direction is unobservable
    weighed       (K, 3)      information times offset
    prior         (3, 3)      information of an offset of 0
    """
    inverse = np.linalg.pinv(information, hermitian=True)
    counts = np.ones(len(weighed))
    offset, covariance = np.zeros(3), prior
    for _ in range(4):
        covariance = np.linalg.inv(np.einsum("k,kij->ij", counts, information) + prior)
        offset = covariance @ (counts @ weighed)
        off = information @ offset - weighed
        chi2 = SCANS_WITH_SAME_ERRORS * np.einsum("ki,kij,kj->k", off, inverse, off)
        excess = max(float(np.median(chi2)) / CHI2_MEDIAN_OF_3, 1.0)
        counts = 1.0 / (1.0 + chi2 / (ROBUST_CHI2 * excess))
    return offset, covariance


def _bounded(correction: Matrix, covariance: Matrix) -> Matrix:
    """(3,) the correction, m, m, rad; in directions that are known no better than before the search at most
    by its sigmas.

    Else a few chance inliers put the next scans where nothing is right: those of a laser that looks to the
    front, in a map of what lies behind.
    """
    scale = np.sqrt(np.diag(SEARCHED))
    variances, directions = np.linalg.eigh(covariance / np.outer(scale, scale))
    steps = directions.T @ (correction / scale)
    steps = np.where(variances <= 1.0, steps, np.clip(steps, -1.0, 1.0))
    bounded: Matrix = scale * (directions @ steps)
    return bounded
