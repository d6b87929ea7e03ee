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
from service.kernels.filter_state import (
    COVARIANCE,
    LOCAL_BLOCK,
    MAP_BLOCK,
    STUDENT,
    Filter,
    MotionSettings,
    PackedFilter,
    views_of,
)
from service.kernels.tracks import Track

Matrix = npt.NDArray[np.float64]


class ConsistentCovariance:
    """Active while only scans measure the motion."""

    def __init__(self) -> None:
        # Only the covariance is used; the rest is a copy of the estimator's.
        self._packed: PackedFilter | None = None

    def predict(
        self, packed: PackedFilter, odometry: Track, gyro: Track, stamp_ns: int, settings: MotionSettings
    ) -> None:
        """Propagate to the time of a scan; packed: the estimator's state, as of the scan before."""
        if self._packed is not None:
            predict_motion(self.view(packed), odometry, gyro, stamp_ns, settings)

    def switch(self, packed: PackedFilter, is_scan_alone: bool) -> None:
        """Start, or stop and add to `packed` (as of the prediction) the excess of this covariance."""
        if is_scan_alone and self._packed is None:
            self._packed = PackedFilter(packed.numbers.copy(), packed.stamps.copy())
        elif not is_scan_alone and self._packed is not None:
            covariance = views_of(packed).covariance
            own = views_of(self._packed).covariance
            variances, axes = np.linalg.eigh(own[MAP_BLOCK, MAP_BLOCK] - covariance[MAP_BLOCK, MAP_BLOCK])
            covariance[MAP_BLOCK, MAP_BLOCK] += (axes * np.maximum(variances, 0.0)) @ axes.T
            self._packed = None

    def correct(
        self, packed: PackedFilter, pose: SE2, measured: Measurement, settings: MotionSettings
    ) -> None:
        """Apply a match.

        packed  as of the prediction
        pose    of prediction and scan together
        """
        if self._packed is None:
            return
        state = views_of(self._packed)
        state.pose[:] = views_of(packed).pose
        prior = np.linalg.inv(state.covariance[LOCAL_BLOCK, LOCAL_BLOCK])
        off = np.array((SE2(*state.pose.tolist()).inverse() @ pose).log())
        weight = min(1.0, (STUDENT + 3.0) / (STUDENT + float(off @ prior @ off)))  # [12]
        take_match(
            self._packed,
            np.array(pose),
            np.linalg.inv(measured.information + weight * prior),
            weight,
            measured.information,
            settings,
        )

    def widen(self, gap: Matrix) -> None:
        """Add a covariance (3, 3) to that of the predicted pose; see Measurement.gap."""
        if self._packed is not None:
            widen_pose(views_of(self._packed), gap)

    def add_segment_noise(self, noise: Matrix) -> None:
        """As Measurement.segment_noise."""
        if self._packed is not None:
            views_of(self._packed).covariance[MAP_BLOCK, MAP_BLOCK] += noise

    def settle(self, share: float) -> None:
        """As MotionModel.settle."""
        if self._packed is not None:
            transfer_into_map(views_of(self._packed).covariance, share)

    def pose_covariance(self, state: Filter) -> Matrix:
        """(3, 3) against the first scan, base axes."""
        chosen = state if self._packed is None else views_of(self._packed)
        return chosen.covariance[MAP_BLOCK, MAP_BLOCK].copy()

    def view(self, packed: PackedFilter) -> PackedFilter:
        """The estimator's state with this covariance; read-only."""
        if self._packed is None:
            return packed
        self._packed.numbers[:COVARIANCE] = packed.numbers[:COVARIANCE]
        self._packed.stamps[:] = packed.stamps
        return self._packed


def widen_pose(state: Filter, by: Matrix) -> None:
    """Add a covariance (3, 3), base axes, to the pose against the first scan and the local map."""
    for rows in (LOCAL_BLOCK, MAP_BLOCK):
        for columns in (LOCAL_BLOCK, MAP_BLOCK):
            state.covariance[rows, columns] += by
