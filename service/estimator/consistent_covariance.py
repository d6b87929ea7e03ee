"""Covariance of the pose where only scans measure the motion, without chance information; [31].

There a match follows the full information of a scan. By chance featureless walls seem to fix the position
along them, so the filter's covariance shrinks although nothing was measured. This second covariance is
propagated beside it; it is published, weighs the edges of the graph and decides the state.
"""

import math

import numpy as np
import numpy.typing as npt

from service.estimator.motion import Measurement
from service.estimator.standstill import STUCK_M, STUCK_RAD
from service.geometry import poses
from service.geometry.chi2 import CHI2_99999_OF_3
from service.geometry.se2 import SE2
from service.kernels.estimator import predict_motion, take_match
from service.kernels.filter_state import LOCAL_BLOCK, MAP_BLOCK, STUDENT, FilterRecord
from service.kernels.tracks import Track

Matrix = npt.NDArray[np.float64]

MIN_RELATIVE = 1e-9  # information in a direction, relative to the best one: less is none


class ConsistentCovariance:
    """Exists while only scans measure the motion."""

    def __init__(self, record: FilterRecord) -> None:
        """record: the estimator's, as of a prediction."""
        self._record = record.copy()  # only the covariance is used; the rest is a copy of the estimator's
        self.covariance: Matrix = self._record["covariance"][0]

    def add_excess_to(self, record: FilterRecord) -> None:
        """Add the excess of this covariance to the estimator's, as of the same prediction."""
        block = record["covariance"][0, MAP_BLOCK, MAP_BLOCK]
        variances, axes = np.linalg.eigh(self.covariance[MAP_BLOCK, MAP_BLOCK] - block)
        block += (axes * np.maximum(variances, 0.0)) @ axes.T

    def correct(self, record: FilterRecord, pose: SE2, measured: Measurement) -> None:
        """Apply a match.

        record  as of the prediction
        pose    of prediction and scan together
        """
        self._record["pose"] = record["pose"]
        prior = np.linalg.inv(self.covariance[LOCAL_BLOCK, LOCAL_BLOCK])
        off = np.array(SE2(*record["pose"][0].tolist()).between(pose).log())
        weight = min(1.0, (STUDENT + 3.0) / (STUDENT + float(off @ prior @ off)))  # [12]
        take_match(
            self._record,
            np.array(pose),
            np.linalg.inv(measured.information + weight * prior),
            weight,
            measured.information,
        )

    def view(self, record: FilterRecord) -> FilterRecord:
        """The estimator's state with this covariance, which a kernel may propagate."""
        covariance, odometry_used = self.covariance.copy(), self._record["odometry_used"].copy()
        self._record[:] = record
        self.covariance[:] = covariance
        self._record["odometry_used"] = odometry_used
        return self._record


class StandstillCovariance(ConsistentCovariance):
    """Covariance of the pose by odometry that has never moved: the filter's, once it moves; [30]."""

    def __init__(self, record: FilterRecord) -> None:
        """record: the estimator's, as of a prediction."""
        super().__init__(record)
        self._begin = record["pose"][0].copy()

    def predict(self, record: FilterRecord, odometry: Track, gyro: Track, stamp_ns: int) -> bool:
        """Predict to the time of a scan; False: odometry is silent."""
        own = self.view(record)
        predict_motion(own, odometry, gyro, stamp_ns)
        return bool(own["increment"]["has_odometry"][0])

    def joined(self, record: FilterRecord, pose: SE2, measured: Measurement) -> SE2 | None:
        """A match with this prior; None: the scan contradicts it, or the scans have moved farther.

        pose   of scan and the estimator's prediction together
        """
        predicted, information = SE2(*record["pose"][0].tolist()), measured.information
        local = record["covariance"][0, LOCAL_BLOCK, LOCAL_BLOCK]
        off = np.array(predicted.between(pose).log())
        weighted = (information + measured.prior_weight * np.linalg.inv(local)) @ off
        own = np.linalg.inv(self.covariance[LOCAL_BLOCK, LOCAL_BLOCK])
        step = np.linalg.solve(information + own, weighted)
        alone = np.linalg.pinv(information, MIN_RELATIVE, hermitian=True) @ weighted
        x_m, y_m, turn_rad = self.moved(record).tolist()
        is_far = math.hypot(x_m, y_m) > STUCK_M or abs(turn_rad) > STUCK_RAD
        if is_far or weighted @ (alone - step) > CHI2_99999_OF_3:
            return None
        return predicted @ SE2.exp(*step.tolist())

    def moved(self, record: FilterRecord) -> Matrix:
        """(3,) m, m, rad, base axes: motion by the scans since odometry was heard first."""
        return poses.between(self._begin, record["pose"][0])
