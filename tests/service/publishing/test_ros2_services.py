"""Services and initial poses of ROS 2 over loopback, asked as a client of rmw_zenoh asks."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh

from drivers.rmw_zenoh import Attachment
from service.encoding import ros_services
from service.geometry.se2 import SE2
from service.mapstore.tiles import TileStore
from service.outputs import TileUpdate
from service.publishing import query_workers
from service.publishing.commands import refusal
from service.publishing.config import PublishingConfig
from service.publishing.ros2_topics import Ros2Topics
from service.publishing.session import listened_at
from service.publishing.shared import SharedZenoh
from tests.service.publishing.conftest import Asked
from tests.service.publishing.test_initial_pose import payload_of
from tests.service.test_encoding_ros_services import JAZZY

CONFIG = PublishingConfig(listen=("tcp/127.0.0.1:0",), ros2={"enabled": True, "namespace": "veh1"})
GID = bytes(range(16))
INITIAL_POSE_KEY = (
    "0/veh1/initialpose/geometry_msgs::msg::dds_::PoseWithCovarianceStamped_/"
    + JAZZY.hash_rihs01("geometry_msgs/msg/PoseWithCovarianceStamped")
)


@pytest.fixture
def maps(tmp_path: Path) -> Path:
    (tmp_path / "office").mkdir()
    return tmp_path


@pytest.fixture
def topics(requested: Asked, store: TileStore, maps: Path) -> Iterator[Ros2Topics]:
    shared = SharedZenoh()
    opened = Ros2Topics(CONFIG, shared, store)
    opened.answer(requested, maps)
    yield opened
    requested.go.set()
    opened.close()


@pytest.fixture
def session(topics: Ros2Topics, open_client: Callable[[str], zenoh.Session]) -> zenoh.Session:
    return open_client(listened_at(topics.session, CONFIG)[0])


def ask(
    session: zenoh.Session, name: str, service: str, request: bytes, attachment: bytes | None = None
) -> list[zenoh.Reply]:
    dds = service.replace("/srv/", "::srv::dds_::") + "_"
    key = f"0/veh1/corridor/{name}/{dds}/{ros_services.service_hash(service)}"
    beside = Attachment(41, 5, GID).encode() if attachment is None else attachment
    return list(session.get(key, payload=request, attachment=beside, timeout=20.0))


def answer(session: zenoh.Session, name: str, service: str, **request: Any) -> Any:
    """The response, as rosbags reads it."""
    short = service.rpartition("/")[2]
    payload = b"\x00\x01\x00\x00\x00"
    if request:
        kind = f"x/msg/{short}Request"
        payload = bytes(JAZZY.serialize_cdr(JAZZY.types[kind](**request), kind))
    (reply,) = ask(session, name, service, payload)
    return JAZZY.deserialize_cdr(reply.ok.payload.to_bytes(), f"x/msg/{short}Response")


def save(session: zenoh.Session, map_url: str = "", image_format: str = "pgm") -> bool:
    request = {"map_topic": "/map", "map_url": map_url, "image_format": image_format, "map_mode": ""}
    return answer(
        session, "save_map", ros_services.SAVE_MAP, **request, free_thresh=0.25, occupied_thresh=0.65
    ).result


@pytest.mark.parametrize(
    ("name", "verb"), [("pause", "pause"), ("resume", "resume"), ("save", "save_map"), ("reset", "reset_map")]
)
def test_a_trigger_is_a_command(session, requested, name, verb):
    response = answer(session, name, ros_services.TRIGGER)
    assert (response.success, response.message) == (True, '{"ok": true}')
    assert requested.heard == [(verb, b"")]


def test_a_command_that_fails_is_an_answer_without_success_and_counted(
    session, topics, requested, monkeypatch, caplog
):
    monkeypatch.setattr(type(requested), "__call__", lambda self, verb, payload: refusal("the disk is full"))
    response = answer(session, "save", ros_services.TRIGGER)
    assert (response.success, response.message) == (False, "the disk is full")
    assert not save(session, "office")
    assert topics.counts()["answered"]["refused"] == 2
    assert caplog.text.count("the disk is full") == 2


@pytest.mark.parametrize("attachment", [b"", bytes(77)])
def test_a_request_without_its_attachment_gets_an_error_and_is_not_done(
    session, topics, requested, attachment
):
    (reply,) = ask(session, "pause", ros_services.TRIGGER, b"\x00\x01\x00\x00\x00", attachment)
    assert "expected 33" in reply.err.payload.to_string()
    assert requested.heard == []
    assert topics.counts()["answered"]["refused"] == 1


@pytest.mark.parametrize(
    ("url", "name"),
    [
        ("office", "office"),
        ("file://{maps}/office", "office"),
        ("file://{maps}/office/map.yaml", "office"),
        ("file:///srv/office/map.yaml", "/srv/office/map.yaml"),  # which the command refuses
        ("file://{maps}/../office", "{maps}/../office"),
    ],
)
def test_load_map_takes_a_name_or_the_file_of_a_map_in_the_folder_of_maps(
    session, requested, store, maps, url, name
):
    url, name = url.format(maps=maps), name.format(maps=maps)
    store.update([TileUpdate(0, 0, 0, 3, 0.05, np.full((64, 64), 3, np.int8))])
    response = answer(session, "load_map", ros_services.LOAD_MAP, map_url=url)
    assert requested.heard == [("load_map", json.dumps({"map": name}).encode())]
    assert (response.result, response.map.info.width, response.map.data.max()) == (0, 64, 3)


def test_load_map_answers_with_an_empty_map_while_none_is_rendered(session):
    response = answer(session, "load_map", ros_services.LOAD_MAP, map_url="office")
    assert (response.result, response.map.info.width) == (0, 0)


@pytest.mark.parametrize(
    ("url", "result"),
    [("nowhere", 1), ("office", 255), ("package://nav2/maps/office.yaml", 255), ("/etc", 1), ("../..", 1)],
)
def test_load_map_says_whether_the_map_is_missing_or_wrong(
    session, topics, requested, monkeypatch, caplog, url, result
):
    monkeypatch.setattr(type(requested), "__call__", lambda self, verb, payload: refusal("not so"))
    response = answer(session, "load_map", ros_services.LOAD_MAP, map_url=url)
    assert response.result == result
    assert caplog.records
    assert topics.counts()["answered"]["refused"] == 1


def test_save_map_saves_under_the_name(session, requested):
    assert save(session, "office")
    assert save(session)
    assert requested.heard == [("save_map", b'{"name": "office"}'), ("save_map", b"{}")]


@pytest.mark.parametrize("request_bytes", [b"", b"\x00\x01\x00\x00", b"\xff" * 40])
def test_garbage_is_refused_and_the_service_goes_on(session, requested, topics, request_bytes):
    (reply,) = ask(session, "load_map", ros_services.LOAD_MAP, request_bytes)
    response = JAZZY.deserialize_cdr(reply.ok.payload.to_bytes(), "x/msg/LoadMapResponse")
    assert response.result == 255
    assert requested.heard == []
    assert answer(session, "pause", ros_services.TRIGGER).success
    assert topics.counts()["answered"]["refused"] == 1


def test_too_many_requests_at_once_are_refused_with_the_reason(session, requested, monkeypatch):
    monkeypatch.setattr(query_workers, "MAX_AT_ONCE", 0)
    response = answer(session, "pause", ros_services.TRIGGER)
    assert not response.success
    assert "ask again in a moment" in response.message


def test_a_pose_on_initialpose_becomes_set_pose(session, topics, requested):
    session.put(INITIAL_POSE_KEY, payload_of(SE2(1.25, -2.5, 3.0)))
    assert requested.entered.acquire(timeout=20.0)
    verb, payload = requested.heard[0]
    assert verb == "set_pose"
    assert json.loads(payload) == pytest.approx({"x_m": 1.25, "y_m": -2.5, "theta_rad": 3.0}, abs=1e-9)


def test_a_pose_that_is_refused_is_kept_for_health(session, topics, requested):
    session.put(INITIAL_POSE_KEY, payload_of(SE2(1.0, 2.0, 3.0), "odom"))
    list(session.get("behind/what/went/before"))
    topics.close()
    assert topics.pose_refused == "initialpose: a pose in the frame 'odom'; expected 'map'"
