"""Poses of all scans from those of the few that a graph corrected."""

from bisect import bisect_right
from collections.abc import Sequence

from service.geometry.se2 import SE2, wrap_angle
from service.mapper.components import Correction
from service.outputs import MapperOutput


def corrected(outputs: Sequence[MapperOutput], corrections: Sequence[Correction]) -> list[SE2]:
    """pose_map_base of each output, the way between corrected scans bent so that it meets them.

    Between two corrected scans each scan is moved by both corrections, weighed by its stamp, so its motion
    against its neighbours stays that of `odom`. Before the first and after the last, theirs alone holds.
    corrections rise by stamp; where there are none, the poses are as they were published.
    """
    if not corrections:
        return [output.pose_map_base for output in outputs]
    stamps = [correction.stamp_ns for correction in corrections]
    poses = []
    for output in outputs:
        right = bisect_right(stamps, output.stamp_ns)
        before = _moved(corrections[max(right - 1, 0)], output.pose_odom_base)
        if right in (0, len(corrections)):
            poses.append(before)
            continue
        after = _moved(corrections[right], output.pose_odom_base)
        share = (output.stamp_ns - stamps[right - 1]) / (stamps[right] - stamps[right - 1])
        poses.append(
            SE2(
                before.x_m + share * (after.x_m - before.x_m),
                before.y_m + share * (after.y_m - before.y_m),
                wrap_angle(before.theta_rad + share * wrap_angle(after.theta_rad - before.theta_rad)),
            )
        )
    return poses


def _moved(correction: Correction, pose_odom_base: SE2) -> SE2:
    return correction.pose_map_base @ (correction.pose_odom_base.inverse() @ pose_odom_base)
