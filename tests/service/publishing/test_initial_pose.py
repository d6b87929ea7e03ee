"""Poses on initialpose become set_pose; what is no pose is refused and reported."""

import json
import logging
import math

import numpy as np
import pytest
import zenoh

from service.encoding import ros_messages as ros
from service.encoding import wire
from service.geometry.se2 import SE2
from service.publishing import initial_pose
from service.publishing.zenoh_publisher import ZenohPublisher
from tests.service.publishing.conftest import Asked

KEY = "corridor/v1/veh1/initialpose"


def payload_of(pose: SE2, frame: str = "map") -> bytes:
    content = ros.geometry_msgs__msg__PoseWithCovarianceStamped(
        wire.header_ros(5, frame),
        ros.geometry_msgs__msg__PoseWithCovariance(wire.planar_pose_ros(pose), np.zeros(36)),
    )
    return wire.to_message("initialpose", wire.INITIAL_POSE, 5, 5, content).payload


def behind(client: zenoh.Session) -> None:
    """When what was put before has arrived: an answer comes over the same connection."""
    list(client.get("corridor/v1/veh1/pose"))


@pytest.mark.parametrize("frame", ["map", "/map"])
def test_a_pose_becomes_set_pose(
    served: ZenohPublisher,
    client: zenoh.Session,
    requested: Asked,
    frame: str,
    caplog: pytest.LogCaptureFixture,
):
    caplog.set_level(logging.INFO, initial_pose.log.name)
    client.put(KEY, payload_of(SE2(1.25, -2.5, 3.0), frame))
    assert requested.entered.acquire(timeout=20.0)
    verb, payload = requested.heard[0]
    assert verb == "set_pose"
    assert json.loads(payload) == pytest.approx({"x_m": 1.25, "y_m": -2.5, "theta_rad": 3.0}, abs=1e-9)
    served.close()
    assert served.pose_refused == ""
    assert [record.getMessage() for record in caplog.records] == [
        "initialpose: looked for at (1.25, -2.50) m, 3.00 rad"
    ]


@pytest.mark.parametrize(
    ("payload", "words"),
    [
        (payload_of(SE2(1.0, 2.0, 0.0), "odom"), "initialpose: a pose in the frame 'odom'; expected 'map'"),
        (payload_of(SE2(math.nan, 2.0, 0.0)), "initialpose: (nan, 2.0) m, 0.0 rad is no pose"),
        (b"\x00\x01", "initialpose: 2 bytes cannot be read as a geometry_msgs/msg/PoseWithCovarianceStamped"),
    ],
)
def test_what_is_no_pose_of_the_map_is_refused_and_reported(
    served: ZenohPublisher, client: zenoh.Session, requested: Asked, payload: bytes, words: str, caplog
):
    client.put(KEY, payload)
    behind(client)
    served.close()
    assert served.pose_refused.startswith(words)
    assert words in caplog.text
    assert requested.heard == []


def test_a_refusal_of_the_command_is_reported_in_its_words(
    publisher: ZenohPublisher, client: zenoh.Session, requested: Asked
):
    def refused(verb: str, payload: bytes):
        requested(verb, payload)
        return requested("refuse", b"")

    publisher.answer_commands(refused)
    client.put(KEY, payload_of(SE2()))
    assert requested.entered.acquire(timeout=20.0)
    assert requested.entered.acquire(timeout=20.0)
    publisher.close()
    assert publisher.pose_refused == "initialpose: no"


def test_a_pose_for_all_vehicles_is_refused(served: ZenohPublisher, client: zenoh.Session, requested: Asked):
    client.put("corridor/v1/*/initialpose", payload_of(SE2(1.0, 0.0, 0.0)))
    behind(client)
    served.close()
    assert served.pose_refused.startswith("initialpose: a pose for corridor/v1/*/initialpose; a pose, as a")
    assert requested.heard == []
