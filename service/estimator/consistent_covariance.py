"""Covariance of the pose where only scans measure the motion, without chance information; [31].

There a match follows the full information of a scan. By chance featureless walls seem to fix the position
along them, so the filter's covariance shrinks although nothing was measured. This second covariance is
propagated beside it; it is published, weighs the edges of the graph and decides the state.
"""

import numpy as np
import numpy.typing as npt

from service.estimator.motion import Measurement
from service.geometry.se2 import SE2
from service.kernels.estimator import predict_motion, take_match, transfer_into_map
from service.kernels.filter_state import LOCAL_BLOCK, MAP_BLOCK, STUDENT, FilterRecord
from service.kernels.tracks import Track

Matrix = npt.NDArray[np.float64]


class ConsistentCovariance:
    """Active while only scans measure the motion."""

    def __init__(self) -> None:
        # Only the covariance is used; the rest is a copy of the estimator's.
        self._record: FilterRecord | None = None

    def predict(self, record: FilterRecord, odometry: Track, gyro: Track, stamp_ns: int) -> None:
        """Propagate to the time of a scan; record: the estimator's, as of the scan before."""
        if self._record is not None:
            predict_motion(self.view(record), odometry, gyro, stamp_ns)

    def switch(self, record: FilterRecord, is_scan_alone: bool) -> None:
        """Start, or stop and add to `record` (as of the prediction) the excess of this covariance."""
        if is_scan_alone and self._record is None:
            self._record = record.copy()
        elif not is_scan_alone and self._record is not None:
            covariance, own = record["covariance"][0], self._record["covariance"][0]
            variances, axes = np.linalg.eigh(own[MAP_BLOCK, MAP_BLOCK] - covariance[MAP_BLOCK, MAP_BLOCK])
            covariance[MAP_BLOCK, MAP_BLOCK] += (axes * np.maximum(variances, 0.0)) @ axes.T
            self._record = None

    def correct(self, record: FilterRecord, pose: SE2, measured: Measurement) -> None:
        """Apply a match.

        record  as of the prediction
        pose    of prediction and scan together
        """
        if self._record is None:
            return
        self._record["pose"] = record["pose"]
        prior = np.linalg.inv(self._record["covariance"][0, LOCAL_BLOCK, LOCAL_BLOCK])
        off = np.array((SE2(*record["pose"][0].tolist()).inverse() @ pose).log())
        weight = min(1.0, (STUDENT + 3.0) / (STUDENT + float(off @ prior @ off)))  # [12]
        take_match(
            self._record,
            np.array(pose),
            np.linalg.inv(measured.information + weight * prior),
            weight,
            measured.information,
        )

    def widen(self, gap: Matrix) -> None:
        """Add a covariance (3, 3) to that of the predicted pose; see Measurement.gap."""
        if self._record is not None:
            widen_pose(self._record["covariance"][0], gap)

    def add_segment_noise(self, noise: Matrix) -> None:
        """As Measurement.segment_noise."""
        if self._record is not None:
            self._record["covariance"][0, MAP_BLOCK, MAP_BLOCK] += noise

    def settle(self, share: float) -> None:
        """As MotionModel.settle."""
        if self._record is not None:
            transfer_into_map(self._record["covariance"][0], share)

    def pose_covariance(self, record: FilterRecord) -> Matrix:
        """(3, 3) against the first scan, base axes."""
        chosen = record if self._record is None else self._record
        pose_covariance: Matrix = chosen["covariance"][0, MAP_BLOCK, MAP_BLOCK].copy()
        return pose_covariance

    def view(self, record: FilterRecord) -> FilterRecord:
        """The estimator's state with this covariance; read-only."""
        if self._record is None:
            return record
        own = self._record["covariance"].copy()
        self._record[:] = record
        self._record["covariance"] = own
        return self._record


def widen_pose(covariance: Matrix, by: Matrix) -> None:
    """Add a covariance (3, 3), base axes, to the pose against the first scan and the local map."""
    for rows in (LOCAL_BLOCK, MAP_BLOCK):
        for columns in (LOCAL_BLOCK, MAP_BLOCK):
            covariance[rows, columns] += by
