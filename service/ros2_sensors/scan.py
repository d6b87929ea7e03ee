"""sensor_msgs/LaserScan of a ROS 2 node as a type of sensor."""

from service.encoding import LASER_SCAN
from service.ros2_sensors.config import Ros2ScanConfig
from service.ros2_sensors.kind import kind_of

KIND = kind_of(Ros2ScanConfig, LASER_SCAN, "scans", laser=True)
