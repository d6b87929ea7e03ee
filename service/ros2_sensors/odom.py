"""nav_msgs/Odometry of a ROS 2 node as a type of sensor."""

from service.encoding import ODOMETRY
from service.ros2_sensors.config import Ros2OdomConfig
from service.ros2_sensors.kind import kind_of

KIND = kind_of(Ros2OdomConfig, ODOMETRY, "samples")
