"""A fake ROS 2 node with an inertial unit as a type of device: its options and its wire."""

import numpy as np
from pydantic import Field

from drivers.frames import ImuSample
from service.encoding import IMU
from simulators.device_kind import DeviceKind, MountedOptions
from simulators.inertial import ImuMounting, InertialTruth
from simulators.kinds.ros2_node import NodeOptions, serve
from simulators.ros2_node import FakeNode, NodeSetup
from simulators.truth import Ride
from simulators.zenoh_wire import ZenohWire


class ImuOptions(NodeOptions, MountedOptions):
    """Options of `ros2_imu:`."""

    rate_hz: float = Field(default=100.0, gt=0.0, le=400.0)


def build(name: str, options: ImuOptions, ride: Ride, seed: int) -> ZenohWire:
    mounting = ImuMounting(options.x_m, options.y_m, options.yaw_rad)
    source = InertialTruth(ride, name, mounting, seed=seed)

    def measure(at_ns: int) -> ImuSample:
        measured = source.inertial(np.array([at_ns], np.int64))
        rx, ry, rz = measured.rate_radps[0].tolist()
        fx, fy, fz = measured.force_mps2[0].tolist()
        return ImuSample(name, at_ns, at_ns, (rx, ry, rz), (fx, fy, fz))

    setup = NodeSetup(round(1e9 / options.rate_hz), clock_drift_ppm=options.clock_drift_ppm)
    return serve(FakeNode(measure, setup), options, "/imu", IMU)


KIND = DeviceKind(ImuOptions, build)
