"""Whether a laser is mounted as configured: its scans against a map that other lasers have made.

A mounting that is wrong by some degrees cannot be seen in that laser's own map: it agrees with itself. Taken
for right it tears the map of the others. So a laser that joins others is aligned with their map first, with
no say in pose and map, until its offset from the configured mounting is known. The offset is estimated by
least squares over scans; the mounting is expected to be right within MOUNTING_TOLERANCE. In a map that has
just begun a search may put a scan somewhere else, turned by 90 degrees in a room: a scan that contradicts the
others has less weight, as in odometry_mounting. A corridor looks the same ahead and behind: whether the laser
looks the other way is decided by what contradicts either of the two on known ground.
"""

import math
from dataclasses import replace

import numpy as np

from service.estimator.motion import Matrix, Measurement, Prediction
from service.geometry.chi2 import CHI2_999_OF_3, CHI2_MEDIAN_OF_3
from service.geometry.se2 import SE2
from service.mapper.checks.stamp_check import BATCH, SCANS_WITH_SAME_ERRORS
from service.outputs import NO_REASON, Reason

MOUNTING_TOLERANCE = np.diag([0.03, 0.03, math.radians(0.5)]) ** 2  # m, m, rad: as people measure it
SEARCHED = np.diag([0.10, 0.10, math.radians(6.0)]) ** 2  # sigmas of the search for its scans meanwhile
ROBUST_CHI2 = 9.0  # of a scan, or a step, that counts half
MIN_ADVANTAGE = 0.1  # of looking one way over the other: agreement with known ground
KNOWN_RAD, KNOWN_M = math.radians(0.3), 0.02  # the heading, and the position in its best direction


class MountingCheck:
    """Of one laser. `is_right` until there is something to compare it with; see `begin`.

    One that has a `fault` is not mapped, also where it is the only one left: it would tear the map.
    """

    def __init__(self) -> None:
        self.is_right = True
        self.fault = NO_REASON  # by how much it is off, once that is known
        self._advantage = 0.0  # sum over batches
        self._offset = np.zeros(3)  # of the sensor from where it should sit, base axes: m, m, rad
        self._begin_batch()

    def begin(self) -> None:
        """Another laser has begun the map: this one is to be compared with it."""
        self.is_right = False

    def where_to_look(self, predicted: Prediction, late_s: float) -> Prediction:
        """Where its scan is looked for on the map, and how wide around. late_s: of its stamps."""
        forward_mps, left_mps, turn_radps = predicted.twist_base
        since = SE2.exp(late_s * forward_mps, late_s * left_mps, late_s * turn_radps)
        measured_at = predicted.pose_odom_base @ since.inverse()
        return replace(
            predicted.less_known(SEARCHED),
            pose_odom_base=measured_at @ SE2.exp(*self._offset.tolist()),
        )

    def add(self, looked_for: Prediction, measured: Measurement, advantage: float | None = None) -> None:
        """A scan, aligned with the map from `where_to_look`. advantage: as in Match.

        Prediction and scan together lie C I e from the prediction, with C their covariance, I the scan's
        information and e where the scan alone lies; so I e is found without inverting I.
        """
        off = (looked_for.pose_odom_base.inverse() @ measured.pose_odom_base).log()
        self._information.append(measured.information / SCANS_WITH_SAME_ERRORS)
        self._weighed.append(np.linalg.inv(measured.covariance) @ off / SCANS_WITH_SAME_ERRORS)
        self._advantages.append(MIN_ADVANTAGE if advantage is None else advantage)
        if len(self._weighed) == BATCH:
            self._judge()
            self._begin_batch()

    def miss(self) -> None:
        """A scan that fitted nowhere around."""
        self._missed += 1
        if self._missed >= BATCH:
            self._begin_batch()
            self.fault = Reason(
                "laser_mounting",
                "does not fit the map of the other lasers, even after a search around its configured "
                "mounting; it is not mapped. Are its mounting and theirs as configured?",
            )

    def _begin_batch(self) -> None:
        self._information: list[Matrix] = []  # (3, 3) of each scan
        self._weighed: list[Matrix] = []  # (3,) its offset, times that
        self._advantages: list[float] = []
        self._missed = 0

    def _judge(self) -> None:
        # A direction that no scan has fixed says nothing: there the offset stays what it was.
        further, covariance = _robust_mean(np.array(self._information), np.array(self._weighed))
        self._offset = self._offset + further
        sigma_m = math.sqrt(float(np.linalg.eigvalsh(covariance[:2, :2])[0]))
        if math.sqrt(covariance[2, 2]) > KNOWN_RAD or sigma_m > KNOWN_M:
            return
        self._advantage += float(np.mean(self._advantages))
        if abs(self._advantage) < MIN_ADVANTAGE:  # ahead and behind look alike so far
            return
        chi2 = float(self._offset @ np.linalg.solve(covariance + MOUNTING_TOLERANCE, self._offset))
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


def _robust_mean(information: Matrix, weighed: Matrix) -> tuple[Matrix, Matrix]:
    """(3,) offset m, m, rad and its covariance (3, 3).

    information   (K, 3, 3)   of each scan, singular where it leaves a direction open
    weighed       (K, 3)      its offset, times that
    """
    inverse = np.linalg.pinv(information, hermitian=True)
    prior = 1e-3 * np.linalg.inv(MOUNTING_TOLERANCE)
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
