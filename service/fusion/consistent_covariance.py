"""Covariance of the pose where nothing but scans measures the motion, without what they say by chance; [31].

There a match follows all that a scan says, for nothing better is there to be misled, but by chance walls
without end seem to say where along them the vehicle is: the covariance that weighs predictions shrinks by it,
and would call a pose known that nobody measured. This one, propagated beside it, is what is published, what
the graph weighs steps by, and what the state is judged by.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from service.fusion.motion import Measurement
from service.geometry.se2 import SE2
from service.kernels.estimator import predict_motion, take_match, transfer_into_map
from service.kernels.filter_state import LOCAL_BLOCK, MAP_BLOCK, STUDENT, Filter, MotionSettings
from service.kernels.tracks import Track

Matrix = npt.NDArray[np.float64]


class ConsistentCovariance:
    """Exists from a scan on before which nobody measured the motion, until somebody does again."""

    def __init__(self) -> None:
        self._filter: Filter | None = None  # of which the covariance counts; all else is the estimator's
        self._followed: list[tuple[npt.NDArray[Any], npt.NDArray[Any]]] = []  # its arrays, the estimator's

    def predict(
        self, state: Filter, odometry: Track, gyro: Track, stamp_ns: int, settings: MotionSettings
    ) -> None:
        """Goes on to the moment of a scan; state: as of the scan before, the estimator's."""
        if self._filter is not None:
            predict_motion(self.beside(state), odometry, gyro, stamp_ns, settings)

    def watch(self, state: Filter, is_scan_alone: bool) -> None:
        """Begins, or ends and leaves in `state` what the pose is known worse; state: as of the prediction."""
        if is_scan_alone and self._filter is None:
            self._filter = _copy_of(state)
            self._followed = _pairs(self._filter, state)
        elif not is_scan_alone and self._filter is not None:
            worse = self._filter.covariance[MAP_BLOCK, MAP_BLOCK] - state.covariance[MAP_BLOCK, MAP_BLOCK]
            variances, axes = np.linalg.eigh(worse)
            state.covariance[MAP_BLOCK, MAP_BLOCK] += (axes * np.maximum(variances, 0.0)) @ axes.T
            self._filter = None

    def correct(self, state: Filter, pose: SE2, measured: Measurement, settings: MotionSettings) -> None:
        """Takes in a match.

        state   as of the prediction
        pose    where scan and prediction together put the base
        """
        if self._filter is None:
            return
        prior = np.linalg.inv(self._filter.covariance[LOCAL_BLOCK, LOCAL_BLOCK])
        off = np.array((SE2(*state.pose.tolist()).inverse() @ pose).log())
        weight = min(1.0, (STUDENT + 3.0) / (STUDENT + float(off @ prior @ off)))  # [12]
        self._filter.pose[:] = state.pose
        take_match(
            self._filter,
            np.array([pose.x_m, pose.y_m, pose.theta_rad]),
            np.linalg.inv(measured.information + weight * prior),
            weight,
            measured.information,
            settings,
        )

    def widen(self, gap: Matrix) -> None:
        """The prediction was known so much less (3, 3) than the model says; see Measurement.gap."""
        if self._filter is not None:
            widen_pose(self._filter, gap)

    def settle(self, share: float) -> None:
        """As MotionModel.settle."""
        if self._filter is not None:
            transfer_into_map(self._filter.covariance, share)

    def of_pose(self, state: Filter) -> Matrix:
        """(3, 3) against the first scan, base axes."""
        chosen = state if self._filter is None else self._filter
        return chosen.covariance[MAP_BLOCK, MAP_BLOCK].copy()

    def beside(self, state: Filter) -> Filter:
        """The estimator's state with this covariance; for reading."""
        if self._filter is None:
            return state
        for own, newest in self._followed:
            own[:] = newest
        return self._filter


def widen_pose(state: Filter, by: Matrix) -> None:
    """The pose is known so much less, (3, 3) in base axes, against the first scan and the local map alike."""
    for rows in (LOCAL_BLOCK, MAP_BLOCK):
        for columns in (LOCAL_BLOCK, MAP_BLOCK):
            state.covariance[rows, columns] += by


def _copy_of(state: Filter) -> Filter:
    path = Track(state.path.stamp_ns.copy(), state.path.value.copy(), state.path.span.copy())
    arrays = {name: kept.copy() for name, kept in state._asdict().items() if name != "path"}
    return Filter(**arrays, path=path)


def _pairs(own: Filter, state: Filter) -> list[tuple[npt.NDArray[Any], npt.NDArray[Any]]]:
    """Each array but the covariances, of two filters."""
    names = [name for name in Filter._fields if name not in ("covariance", "path")]
    arrays = [(getattr(own, name), getattr(state, name)) for name in names]
    return [*arrays, *zip(own.path, state.path, strict=True)]
