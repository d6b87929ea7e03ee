import pytest
from pydantic import ValidationError

from service.config import parse_config
from service.errors import ConfigError
from service.ros2_sensors.config import Ros2ScanConfig
from service.sensor_kinds import SENSOR_KINDS

HEAD = "vehicle: v\nrecording: {directory: r}\nmap: {directory: m}\n"


@pytest.mark.parametrize("text", ["", "/", "a b", "~/scan", "/1scan", "a//b"])
def test_what_is_no_topic_is_refused(text):
    with pytest.raises(ValidationError, match=r"write /scan, say|ROS 2 names are"):
        Ros2ScanConfig(name="laser", topic=text)


@pytest.mark.parametrize("kind", ["ros2_scan", "ros2_odom", "ros2_imu"])
def test_each_type_says_its_own_name_and_whether_it_is_a_laser(kind):
    assert SENSOR_KINDS[kind].config.model_fields["type"].default == kind
    assert SENSOR_KINDS[kind].laser is (kind == "ros2_scan")


@pytest.mark.parametrize("topic", ["/front/scan", "/odom"])
def test_what_corridor_publishes_is_no_sensor_of_it(topic):
    sensor = f"sensors:\n  front: {{type: ros2_scan, topic: {topic}}}\n"
    parse_config(HEAD + sensor, "c")
    with pytest.raises(ConfigError, match=rf"c:5:28: sensors.front.topic: {topic} is published by corridor"):
        parse_config(HEAD + sensor + "publishing: {ros2: {enabled: true}}\n", "c")
    for other in ("namespace: veh1", "domain: 3"):
        parse_config(HEAD + sensor + f"publishing: {{ros2: {{enabled: true, {other}}}}}\n", "c")
