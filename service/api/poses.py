"""Poses as a program gets them, from a mapper, a replay or a running service."""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from service.encoding import decode_pose, encode_pose
from service.encoding.wire import rotation_3x3
from service.outputs import MapperOutput, State


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """The base of the vehicle in the frame of the map, at the first ray of a scan.

    stamp_ns     on the clock of the frames; of a recording or a service Unix time
    theta_rad    counter-clockwise from the x axis of the map, -pi to pi
    covariance   (3, 3) of x, y, theta in the axes of the map; m^2, m rad, rad^2. A variance of 1e6: not known
    twist        (3,) in the axes of the base: m/s forward, m/s left, rad/s
    state        "ok", "degraded" or "lost"; None where it came over the network: `health` has it there
    reason       why it is not "ok", in words; else ""
    """

    stamp_ns: int
    x_m: float
    y_m: float
    theta_rad: float
    covariance: npt.NDArray[np.float64]
    twist: npt.NDArray[np.float64]
    state: State | None = None
    reason: str = ""


def pose_of(output: MapperOutput) -> Pose:
    """To the last digit as a subscriber has it."""
    pose = pose_in_message(encode_pose(output, 0).payload)
    return replace(pose, state=output.state, reason=str(output.reason))


def pose_in_message(payload: bytes) -> Pose:
    """Of a nav_msgs/Odometry. Raises InputError."""
    decoded = decode_pose(payload)
    at, turn = decoded.pose, rotation_3x3(decoded.pose.theta_rad)
    return Pose(
        stamp_ns=decoded.stamp_ns,
        x_m=at.x_m,
        y_m=at.y_m,
        theta_rad=at.theta_rad,
        covariance=turn @ decoded.covariance @ turn.T,
        twist=np.array(decoded.twist),
    )
