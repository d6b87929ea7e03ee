"""sensor_msgs/Imu of a ROS 2 node as a type of sensor."""

from service.encoding import IMU
from service.ros2_sensors.config import Ros2ImuConfig
from service.ros2_sensors.kind import kind_of

KIND = kind_of(Ros2ImuConfig, IMU, "samples")
