"""Names of the frames of base and odometry, alone or behind the prefix of one robot among several."""

import re

from service.encoding import BASE_FRAME, ODOM_FRAME

BASE_FRAMES = (BASE_FRAME, "base_footprint")
ODOM_FRAMES = (ODOM_FRAME, "odom_combined")
_BASE = re.compile(rf"(?P<robot>|.*[/_])({'|'.join(BASE_FRAMES)})")
_ODOMETRY = re.compile(rf"(|.*[/_])({'|'.join(ODOM_FRAMES)})")


def is_odometry(frame: str) -> bool:
    """Whether it is the name of an odometry's frame: odom, robot1/odom, robot1_odom."""
    return _ODOMETRY.fullmatch(frame) is not None


def is_base(frame: str) -> bool:
    """Whether it is the name of a base: base_link, robot1/base_footprint, robot1_base_link."""
    return _BASE.fullmatch(frame) is not None


def robot_of(frame: str) -> str:
    """ "robot1/" of "robot1/base_link", "robot1_" of "robot1_base_link"; of others what is before a /."""
    match = _BASE.fullmatch(frame)
    return match["robot"] if match else frame[: frame.rfind("/") + 1]
