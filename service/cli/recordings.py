"""Options of the commands that read recordings of others: which topics and frames they use."""

import argparse
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from service.recording.choice import Choice

_OPTIONS = {
    "scan_topics": ("TOPIC", "scans to use: LaserScan, MultiEchoLaserScan or PointCloud2; one each time"),
    "odom_topic": ("TOPIC", "odometry: Odometry, or /tf for the edge from its frame to the base"),
    "imu_topic": ("TOPIC", "the Imu to use"),
    "base_frame": ("FRAME", "frame of the vehicle's base (default: found, as base_link or robot1/base_link)"),
    "odom_frame": ("FRAME", "frame of the odometry: frame_id of an Odometry, or above the base in /tf"),
}


def add_choice(parser: argparse.ArgumentParser) -> None:
    """--scan-topic, --odom-topic, --imu-topic, --base-frame, --odom-frame."""
    group = parser.add_argument_group("recordings of others")
    for name, (kind, help_text) in _OPTIONS.items():
        option = f"--{name.removesuffix('s').replace('_', '-')}"
        action = "append" if name.endswith("s") else "store"
        group.add_argument(option, dest=name, metavar=kind, type=_name, action=action, help=help_text)


def choice_of(parsed: argparse.Namespace) -> "Choice":
    """What was given; the rest is left open."""
    from service.recording.choice import Choice

    given = {name: getattr(parsed, name) for name in _OPTIONS if getattr(parsed, name) is not None}
    return Choice(**given)


def _name(text: str) -> str:
    if not text.strip("/"):
        raise argparse.ArgumentTypeError(f"{text!r} is no name")
    return text
