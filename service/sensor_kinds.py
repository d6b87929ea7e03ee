"""Sensor types by name: those of the drivers, and messages of ROS 2 nodes, which service.encoding reads."""

from collections.abc import Mapping

from drivers.lazy_registry import LazyRegistry
from drivers.registry import DRIVERS
from drivers.sensor_kind import SensorKind

SENSOR_KINDS: Mapping[str, SensorKind] = LazyRegistry(
    SensorKind,
    {
        **DRIVERS,
        "ros2_scan": "service.ros2_sensors.scan",
        "ros2_odom": "service.ros2_sensors.odom",
        "ros2_imu": "service.ros2_sensors.imu",
    },
)
