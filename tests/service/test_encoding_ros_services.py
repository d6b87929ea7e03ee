"""Services against published type hashes and against rosbags' reading of their definitions."""

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from service.encoding import ros_messages as ros
from service.encoding import ros_services, wire
from service.errors import InputError

# std_srvs/srv/Trigger as rclcpp's nodes of Jazzy declare it
TRIGGER_HASH = "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f"

JAZZY = get_typestore(Stores.ROS2_JAZZY)  # with the definitions as they stand in the packages
for _name, _definition in {
    "x/msg/TriggerResponse": "bool success\nstring message",
    "x/msg/LoadMapRequest": "string map_url",
    "x/msg/LoadMapResponse": "nav_msgs/OccupancyGrid map\nuint8 result",
    "x/msg/SaveMapRequest": (
        "string map_topic\nstring map_url\nstring image_format\nstring map_mode\n"
        "float32 free_thresh\nfloat32 occupied_thresh"
    ),
    "x/msg/SaveMapResponse": "bool result",
}.items():
    JAZZY.register(get_types_from_msg(_definition, _name))


def test_the_hash_of_a_service_is_that_which_ros_2_publishes():
    assert ros_services.service_hash(ros_services.TRIGGER) == TRIGGER_HASH


def test_a_response_is_read_by_rosbags():
    payload = ros_services.encode_response(ros_services.TRIGGER, success=True, message="done")
    read = JAZZY.deserialize_cdr(payload, "x/msg/TriggerResponse")
    assert (read.success, read.message) == (True, "done")


def test_the_map_in_a_response_is_read_by_rosbags():
    info = ros.nav_msgs__msg__MapMetaData(wire.time_ros(5), 0.05, 2, 1, wire.planar_pose_ros(wire.SE2()))
    grid = ros.nav_msgs__msg__OccupancyGrid(wire.header_ros(5, "map"), info, np.array([0, 100], np.int8))
    payload = ros_services.encode_response(ros_services.LOAD_MAP, map=grid, result=1)
    read = JAZZY.deserialize_cdr(payload, "x/msg/LoadMapResponse")
    assert (read.map.data.tolist(), read.map.header.frame_id, read.result) == ([0, 100], "map", 1)


def test_a_request_that_rosbags_wrote_is_read():
    name = "x/msg/SaveMapRequest"
    payload = JAZZY.serialize_cdr(JAZZY.types[name]("/map", "office", "pgm", "trinary", 0.25, 0.5), name)
    request = ros_services.read_request(ros_services.SAVE_MAP, bytes(payload))
    assert (request.map_topic, request.map_url, request.image_format) == ("/map", "office", "pgm")
    assert (request.map_mode, request.free_thresh, request.occupied_thresh) == ("trinary", 0.25, 0.5)


@pytest.mark.parametrize(
    "payload", [b"", b"\x00\x01\x00\x00", b"\x00\x01\x00\x00\xff\xff\xff\xff", b"garbage"]
)
def test_what_is_no_request_is_refused(payload):
    with pytest.raises(InputError, match="cannot be read as a request to nav2_msgs/srv/LoadMap"):
        ros_services.read_request(ros_services.LOAD_MAP, payload)
