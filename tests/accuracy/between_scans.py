"""A trajectory with the motion of odometry between its scans.

`trajectory.tum` has a pose a scan. Relations whose stamps lie between scans are scored on the straight line
between two poses, which a vehicle that turns does not follow: with a scan a second the line is a good part of
the error.
"""

import numpy as np
import numpy.typing as npt

from drivers.frames import OdometrySample
from service.geometry.poses import between, compose
from service.geometry.se2 import wrap_angle
from service.offline.score.trajectory import Trajectory


def with_odometry(scans: Trajectory, samples: list[OdometrySample]) -> Trajectory:
    """Poses of the scans and, between them, at the stamps of odometry: the scan before, moved on by odometry,
    and the share of time of what odometry and the two scans differ by.
    """
    odometry = _trajectory(samples)
    inside = (odometry.stamp_ns > max(scans.stamp_ns[0], odometry.stamp_ns[0])) & (
        odometry.stamp_ns < min(scans.stamp_ns[-1], odometry.stamp_ns[-1])
    )
    asked = np.setdiff1d(odometry.stamp_ns[inside], scans.stamp_ns)
    right = np.searchsorted(scans.stamp_ns, asked)
    left = right - 1
    known = (scans.stamp_ns[left] >= odometry.stamp_ns[0]) & (scans.stamp_ns[right] <= odometry.stamp_ns[-1])
    asked, left, right = asked[known], left[known], right[known]
    begun = odometry.at(scans.stamp_ns[left])
    moved = between(begun, odometry.at(asked))
    whole = between(begun, odometry.at(scans.stamp_ns[right]))
    differs = between(scans.pose[left], scans.pose[right]) - whole
    differs[:, 2] = wrap_angle(differs[:, 2])
    share = (asked - scans.stamp_ns[left]) / (scans.stamp_ns[right] - scans.stamp_ns[left])
    pose = compose(scans.pose[left], moved + share[:, None] * differs)
    stamp_ns = np.concatenate([scans.stamp_ns, asked])
    order = np.argsort(stamp_ns)
    return Trajectory(stamp_ns[order], np.concatenate([scans.pose, pose])[order])


def _trajectory(samples: list[OdometrySample]) -> Trajectory:
    stamp_ns, first = np.unique([sample.stamp_ns for sample in samples], return_index=True)
    pose: npt.NDArray[np.float64] = np.array([(s.x_m, s.y_m, s.theta_rad) for s in samples])[first]
    return Trajectory(stamp_ns, pose)
