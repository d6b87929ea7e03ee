"""Settings of a sensor whose messages a ROS 2 node publishes."""

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from drivers.mounting import Mounting
from drivers.rmw_zenoh import absolute_name
from drivers.sensor_section import SensorSection
from service.publishing.config import PlainEndpoint


def _check_topic(topic: str) -> str:
    if not (name := absolute_name(topic)):
        raise ValueError("a topic has a name; write /scan, say")
    return name


class Ros2SensorConfig(SensorSection):
    """A topic, and the router by which its publisher is reached."""

    topic: Annotated[str, AfterValidator(_check_topic)]
    router: PlainEndpoint = "tcp/127.0.0.1:7447"  # this service, or rmw_zenohd
    domain: int = Field(default=0, ge=0, le=232)  # ROS_DOMAIN_ID of the node
    silence_timeout_s: float = Field(default=2.0, ge=0.5, le=60.0)  # without a message: subscribe again


class Ros2ScanConfig(Ros2SensorConfig):
    """sensor_msgs/LaserScan."""

    type: Literal["ros2_scan"] = "ros2_scan"
    map: bool = True  # False: its scans are published and recorded, not mapped
    mounting: Mounting = Mounting()


class Ros2ImuConfig(Ros2SensorConfig):
    """sensor_msgs/Imu."""

    type: Literal["ros2_imu"] = "ros2_imu"
    mounting: Mounting = Mounting()


class Ros2OdomConfig(Ros2SensorConfig):
    """nav_msgs/Odometry of the base; its frame is the vehicle's, so there is no mounting."""

    type: Literal["ros2_odom"] = "ros2_odom"
