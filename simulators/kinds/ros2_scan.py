"""A fake ROS 2 node with a laser as a type of device: its options and its wire."""

import math

import numpy as np
from pydantic import Field

from drivers.frames import LaserScan
from service.encoding import LASER_SCAN
from simulators.device import Beams
from simulators.device_kind import DeviceKind, LaserOptions
from simulators.kinds.ros2_node import NodeOptions, serve
from simulators.ros2_node import FakeNode, NodeSetup
from simulators.truth import LMS100, Ride
from simulators.zenoh_wire import ZenohWire

BEAMS, FIRST_DEG, STEP_DEG = 541, -135.0, 0.5
RANGE_MIN_M, RANGE_MAX_M = 0.05, 20.0


class ScanOptions(NodeOptions, LaserOptions):
    """Options of `ros2_scan:`."""

    rate_hz: float = Field(default=25.0, gt=0.0, le=100.0)


def build(name: str, options: ScanOptions, ride: Ride, seed: int) -> ZenohWire:
    source = options.source(ride, name, LMS100, seed)
    period_ns = round(1e9 / options.rate_hz)
    beam_ns = round(period_ns * STEP_DEG / 360.0)

    def measure(at_ns: int) -> LaserScan:
        first_rad, step_rad = math.radians(FIRST_DEG), math.radians(STEP_DEG)
        sweep = source.sweep(Beams(at_ns, beam_ns, first_rad, step_rad, BEAMS))
        return LaserScan(
            sensor=name,
            stamp_ns=at_ns,
            arrived_ns=at_ns,
            beam_interval_ns=beam_ns,
            scan_period_ns=period_ns,
            first_angle_rad=first_rad,
            angle_step_rad=step_rad,
            range_min_m=RANGE_MIN_M,
            range_max_m=RANGE_MAX_M,
            range_m=sweep.range_m,
            intensity=(255.0 * sweep.intensity).astype(np.float32),
        )

    setup = NodeSetup(period_ns, (BEAMS - 1) * beam_ns, clock_drift_ppm=options.clock_drift_ppm)
    return serve(FakeNode(measure, setup), options, "/scan", LASER_SCAN)


KIND = DeviceKind(ScanOptions, build)
