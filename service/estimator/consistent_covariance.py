"""Covariance of the pose where only scans measure the motion, without chance information; [31].

There a match follows the full information of a scan. By chance featureless walls seem to fix the position
along them, so the filter's covariance shrinks although nothing was measured. This second covariance is
propagated beside it; it is published, weighs the edges of the graph and decides the state.
"""

import numpy as np
import numpy.typing as npt

from service.estimator.motion import Measurement
from service.geometry.se2 import SE2
from service.kernels.estimator import take_match
from service.kernels.filter_state import LOCAL_BLOCK, MAP_BLOCK, STUDENT, FilterRecord

Matrix = npt.NDArray[np.float64]


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
        own = self.covariance.copy()
        self._record[:] = record
        self.covariance[:] = own
        return self._record
