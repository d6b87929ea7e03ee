"""Covariance of the pose where nothing but scans measures the motion, without what they say by chance; [31].

There a match follows all that a scan says, for nothing better is there to be misled, but by chance walls
without end seem to say where along them the vehicle is: the covariance that weighs predictions shrinks by it,
and would call a pose known that nobody measured. This one, propagated beside it, is what is published, what
the graph weighs steps by, and what the state is judged by.
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
    """Exists from a scan on before which nobody measured the motion, until somebody does again."""

    def __init__(self) -> None:
        # The covariance counts; all else is the estimator's.
        self._packed: PackedFilter | None = None

    def predict(
        self, packed: PackedFilter, odometry: Track, gyro: Track, stamp_ns: int, settings: MotionSettings
    ) -> None:
        """Goes on to the moment of a scan; packed: the estimator's state, as of the scan before."""
        if self._packed is not None:
            predict_motion(self.beside(packed), odometry, gyro, stamp_ns, settings)

    def watch(self, packed: PackedFilter, is_scan_alone: bool) -> None:
        """Begins, or ends and leaves in `packed`, as of the prediction, what the pose is known worse."""
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
        """Takes in a match.

        packed  as of the prediction
        pose    where scan and prediction together put the base
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
            np.array([pose.x_m, pose.y_m, pose.theta_rad]),
            np.linalg.inv(measured.information + weight * prior),
            weight,
            measured.information,
            settings,
        )

    def widen(self, gap: Matrix) -> None:
        """The prediction was known so much less (3, 3) than the model says; see Measurement.gap."""
        if self._packed is not None:
            widen_pose(views_of(self._packed), gap)

    def settle(self, share: float) -> None:
        """As MotionModel.settle."""
        if self._packed is not None:
            transfer_into_map(views_of(self._packed).covariance, share)

    def of_pose(self, state: Filter) -> Matrix:
        """(3, 3) against the first scan, base axes."""
        chosen = state if self._packed is None else views_of(self._packed)
        return chosen.covariance[MAP_BLOCK, MAP_BLOCK].copy()

    def beside(self, packed: PackedFilter) -> PackedFilter:
        """The estimator's state with this covariance; for reading."""
        if self._packed is None:
            return packed
        self._packed.numbers[:COVARIANCE] = packed.numbers[:COVARIANCE]
        self._packed.stamps[:] = packed.stamps
        return self._packed


def widen_pose(state: Filter, by: Matrix) -> None:
    """The pose is known so much less, (3, 3) in base axes, against the first scan and the local map alike."""
    for rows in (LOCAL_BLOCK, MAP_BLOCK):
        for columns in (LOCAL_BLOCK, MAP_BLOCK):
            state.covariance[rows, columns] += by
