"""Key expressions on Zenoh. Version first, vehicle second: one rule or one subscription covers a fleet."""

import re

ROOT = "corridor/v1"
NAME = re.compile(r"[a-z][a-z0-9]*(_[a-z0-9]+)*")  # a chunk of a Zenoh key and a ROS 2 name at once
NAME_RULE = "lower-case letters, digits and single _ in between, a letter first, at most 32 of them"
MAX_NAME_LENGTH = 32


def is_name(text: str) -> bool:
    """Whether a vehicle or sensor may be called so."""
    return len(text) <= MAX_NAME_LENGTH and NAME.fullmatch(text) is not None


def vehicle_key(vehicle: str, channel: str) -> str:
    """Key of a channel: "front/scan" of veh1 is at corridor/v1/veh1/front/scan."""
    return f"{ROOT}/{vehicle}/{channel}"


def alive_key(vehicle: str, component: str) -> str:
    """Key of the liveliness token that exists while a component works."""
    return vehicle_key(vehicle, f"alive/{component}")
