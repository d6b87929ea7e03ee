"""A fake node with a laser, and a session that listens to it, in virtual time."""

import numpy as np

from drivers.frames import NO_INTENSITY, Frame, LaserScan
from service.encoding import LASER_SCAN
from service.ros2_sensors.config import Ros2ScanConfig
from service.ros2_sensors.session import Ros2Session, pack
from simulators.ros2_node import FakeNode, NodeSetup

PERIOD_NS, BEAM_NS, BEAMS = 40_000_000, 50_000, 541
START_NS = 5_000_000_000_000
SETUP = NodeSetup(PERIOD_NS, BEAM_NS * (BEAMS - 1), clock_drift_ppm=40.0)


def scan(at_ns: int) -> LaserScan:
    """Each beam sees the time."""
    range_m = np.full(BEAMS, 1.0 + (at_ns - START_NS) / 1e11, np.float32)
    sweep = BEAM_NS, PERIOD_NS, -2.0, 0.0075, 0.05, 20.0
    return LaserScan("laser", at_ns, at_ns, *sweep, range_m, NO_INTENSITY)


def config(**changes: object) -> Ros2ScanConfig:
    return Ros2ScanConfig(**{"name": "laser", "topic": "/scan", **changes})


def session(**changes: object) -> Ros2Session:
    return Ros2Session(config(**changes), LASER_SCAN, "scans")


def node(setup: NodeSetup = SETUP) -> FakeNode:
    made = FakeNode(scan, setup)
    made.connected(START_NS)
    return made


def hear(listening: Ros2Session, speaking: FakeNode, count: int) -> list[Frame]:
    """Frames of so many messages, each 2 ms late."""
    frames: list[Frame] = []
    for _ in range(count):
        due_ns = speaking.next_due_ns(0)
        frames += listening.receive_data(pack(speaking.due(due_ns)), due_ns + 2_000_000)
        listening.tick(due_ns + 2_000_000)
    return frames
