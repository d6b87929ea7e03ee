"""Fake ROS 2 nodes with a laser, wheels or an inertial unit: the options all share, and their wire."""

from typing import Annotated

from pydantic import AfterValidator, Field

from drivers.rmw_zenoh import absolute_name
from simulators.device import FakeDevice
from simulators.device_kind import DeviceOptions
from simulators.zenoh_wire import ZenohWire


class NodeOptions(DeviceOptions):
    """Options of all types."""

    host: str = "127.0.0.1"
    port: int = Field(default=0, ge=0, le=65535)  # of its router; 0: any free
    domain: int = Field(default=0, ge=0, le=232)
    topic: Annotated[str, AfterValidator(absolute_name)] = ""  # "": as each type states
    clock_drift_ppm: float = 40.0


def serve(device: FakeDevice, options: NodeOptions, topic: str, message_type: str) -> ZenohWire:
    return ZenohWire(device, options.topic or topic, message_type, options.domain, options.host, options.port)
