"""Whether a detached segment stands still, where nothing but the scans matched to it measures the motion."""

import math
from dataclasses import replace

import numpy as np

from service.estimator.motion import Prediction
from service.geometry.se2 import SE2
from service.mapper.judgement import MAX_SIGMA_M, UNKNOWN_PLACE


class SegmentMotion:
    """People who walk beside a vehicle are a segment that moves with it: on it the vehicle seems to brake.

    The motion on a segment is compared with constant velocity since it began. Their distance is a sigma of
    the pose in the map. Beyond MAX_SIGMA_M the motion counts as unmeasured: the vehicle may have braked, or
    gone on together with the segment.
    """

    def __init__(self) -> None:
        self._began: tuple[int, Prediction] | None = None  # ns; None: there is no segment to compare
        self._is_unmeasured = False  # the motion on that segment
        self._is_paused = False  # no sensor measured the motion to the segment

    def predicted(self, at_ns: int, predicted: Prediction) -> tuple[Prediction, float]:
        """The prediction of a scan with the covariance of the segment's own motion, and for how long, s, the
        motion has not been measured, at the scan at which that shows; else 0.
        """
        if self._began is None:
            return predicted, 0.0
        if self._is_unmeasured:
            return replace(predicted, segment_covariance=UNKNOWN_PLACE), 0.0
        if predicted.increment is not None and not predicted.is_scan_alone:
            self._began = at_ns, predicted
            return predicted, 0.0
        began_ns, first = self._began
        elapsed_s = (at_ns - began_ns) * 1e-9
        constant_velocity = first.pose_odom_base @ SE2.exp(*(elapsed_s * speed for speed in first.twist_base))
        off = constant_velocity.between(predicted.pose_odom_base)
        off_m = math.hypot(off.x_m, off.y_m)
        if off_m <= MAX_SIGMA_M:
            return replace(predicted, segment_covariance=np.diag([off_m**2, off_m**2, 0.0])), 0.0
        self._is_unmeasured = True
        return replace(predicted, segment_covariance=UNKNOWN_PLACE), elapsed_s

    def matched(self, at_ns: int, predicted: Prediction, is_paused: bool, is_on_map: bool) -> None:
        """Take whether the scan of a prediction lay on the map, and not at most on a segment.

        is_paused   by is_motion_unmeasured
        """
        if is_on_map or is_paused:
            self._began, self._is_unmeasured, self._is_paused = None, False, is_paused
        elif self._began is None and not self._is_paused:
            self._began = at_ns, predicted
