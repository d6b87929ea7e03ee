"""Poses of all scans, interpolated between the scans that a graph corrected."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.geometry.se2 import SE2, wrap_angle
from service.mapper.components import Correction
from service.outputs import MapperOutput


def corrected(outputs: Sequence[MapperOutput], corrections: Sequence[Correction]) -> list[SE2]:
    """pose_map_base of each output, interpolated by `bent`; without corrections as published.

    No interpolation into a new segment: up to its first correction the last correction before it applies,
    since the vehicle may have been carried between them.
    """
    if not corrections:
        return [output.pose_map_base for output in outputs]
    stamp_ns = np.array([output.stamp_ns for output in outputs], np.int64)
    at_ns = np.array([correction.stamp_ns for correction in corrections], np.int64)
    of_output = np.searchsorted(stamp_ns, at_ns, side="right") - 1  # a sweep begins before its stamp
    for k in range(1, len(corrections)):
        if corrections[k].begins_segment and of_output[k] > of_output[k - 1]:
            stamp_ns[of_output[k - 1] + 1 : of_output[k]] = at_ns[k - 1]
            stamp_ns[of_output[k]] = at_ns[k]
    poses = bent(
        stamp_ns,
        _rows([output.pose_odom_base for output in outputs]),
        at_ns,
        _rows([correction.pose_odom_base for correction in corrections]),
        _rows([correction.pose_map_base for correction in corrections]),
    )
    return [SE2(*pose) for pose in poses.tolist()]


def bent(
    stamp_ns: npt.NDArray[np.int64],
    poses: Floats,
    at_ns: npt.NDArray[np.int64],
    before: Floats,
    after: Floats,
) -> Floats:
    """(N, 3) poses of a path, corrected so that `before` becomes `after`.

    Between two corrected poses both corrections are interpolated by stamp, which preserves relative motion.
    Before the first and after the last, only that correction applies.

    stamp_ns, poses         (N,) ns and (N, 3) m, m, rad
    at_ns, before, after    (K,) ascending, (K, 3) and (K, 3); K > 0
    """
    left = np.searchsorted(at_ns, stamp_ns, side="right") - 1
    first, second = np.maximum(left, 0), np.minimum(left + 1, len(at_ns) - 1)
    moved, other = (se2.compose(after[k], se2.between(before[k], poses)) for k in (first, second))
    span_ns = at_ns[second] - at_ns[first]
    share = np.divide(stamp_ns - at_ns[first], span_ns, out=np.zeros(len(poses)), where=span_ns > 0)
    step = other - moved
    step[:, 2] = wrap_angle(step[:, 2])
    moved += share[:, None] * step
    moved[:, 2] = wrap_angle(moved[:, 2])
    return moved


def _rows(poses: Sequence[SE2]) -> Floats:
    return np.array([(pose.x_m, pose.y_m, pose.theta_rad) for pose in poses]).reshape(-1, 3)
