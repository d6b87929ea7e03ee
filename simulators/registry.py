"""Fake devices by the type of sensor they stand for. One line per device: the module that holds its KIND."""

from collections.abc import Mapping

from drivers.lazy_registry import LazyRegistry
from simulators.device_kind import DeviceKind

DEVICE_KINDS: Mapping[str, DeviceKind] = LazyRegistry(
    DeviceKind,
    {
        "sick_lms100": "simulators.kinds.sick_lms100",
        "hokuyo_utm30lx": "simulators.kinds.hokuyo_utm30lx",
        "irobot_create": "simulators.kinds.irobot_create",
        "ibeo_lux": "simulators.kinds.ibeo_lux",
        "xsens_mtig": "simulators.kinds.xsens_mtig",
        "ros2_scan": "simulators.kinds.ros2_scan",
        "ros2_odom": "simulators.kinds.ros2_odom",
        "ros2_imu": "simulators.kinds.ros2_imu",
    },
)
