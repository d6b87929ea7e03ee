"""The sink as the service opens it: what goes out, what is in health, and that nothing is encoded twice."""

from collections.abc import Iterator
from contextlib import ExitStack, closing
from itertools import product
from pathlib import Path

import pytest
import zenoh
from rosbags.typesys.store import Typestore

from service.deadline import Deadline
from service.encoding import OK, WARNING, Status, encode_diagnostics, encode_frame, encode_pose, encode_tf
from service.mapstore.tiles import TileStore
from service.publishing.config import PublishingConfig
from service.publishing.session import open_session
from service.recording.mcap_reader import Recording
from service.sinks.fan_out import Sinks
from service.sinks.registry import SINKS
from service.sinks.ros2_sink import Ros2Sink, open_sink
from tests.service.publishing.conftest import Inbox, client_config
from tests.service.publishing.test_ros2_topics import OUTPUT, SCAN
from tests.service.sinks.contexts import sink_context
from tests.service.web.conftest import repeating
from tests.system.machine import free_port
from tests.waiting import wait_until

LOG_NS = 1_700_000_000_000_000_000
LISTEN = ("tcp/127.0.0.1:0",)
CONFIG = PublishingConfig(listen=LISTEN, ros2={"enabled": True, "domain": 3, "namespace": "veh1"})


@pytest.fixture
def sink() -> Iterator[Ros2Sink]:
    opened = open_sink(CONFIG, sink_context(tiles=TileStore()))
    opened.start()
    yield opened
    opened.close()


def test_its_row_holds_what_was_sent_and_warns_of_what_was_not(sink: Ros2Sink):
    assert (sink.health().level, sink.place()) == (OK, "domain 3, /veh1")
    sink.topics.initial_pose.refused = "initialpose: no pose"
    assert sink.health().values["initialpose_refused"] == "initialpose: no pose"
    sink.close()
    sink.put(encode_pose(OUTPUT, LOG_NS))  # its threads have ended
    row = sink.health()
    assert (row.name, row.level, row.message) == (
        "ros2",
        WARNING,
        "1 dropped, 0 failed (expected none); is the network too slow?",
    )
    assert row.values["dropped.pose"] == "1"


def test_its_row_warns_while_the_nodes_router_is_not_there():
    router = f"tcp/127.0.0.1:{free_port()}"
    by_router = {"enabled": True, "router": "connect"}
    config = PublishingConfig(listen=LISTEN, connect=(router,), ros2=by_router)
    with closing(open_sink(config, sink_context())) as sink:
        row = sink.health()
        assert (row.level, row.message) == (
            WARNING,
            f"no router at {router}; start rmw_zenohd there, or change publishing.connect",
        )
        with open_session(PublishingConfig(listen=(router,))):
            wait_until(lambda: sink.health().level == OK)
        wait_until(lambda: sink.health().level == WARNING)


def test_zenoh_ros_and_recording_have_the_same_bytes_encoded_once(tmp_path: Path, monkeypatch):
    scan, health = (
        encode_frame(SCAN, LOG_NS),
        encode_diagnostics("diagnostics", [Status("x", 0, "", {})], 1, LOG_NS),
    )
    messages = [scan, encode_pose(OUTPUT, LOG_NS), encode_tf(OUTPUT, LOG_NS), health]
    context = sink_context(tiles=TileStore())
    sections = {
        "publishing": CONFIG,
        "recording": next(k for k in SINKS if k.section == "recording").load_model()(
            directory=tmp_path, keep_free_gb=0.0
        ),
    }

    def put() -> None:
        for message in messages:
            sinks.put(message)

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("a message was encoded again")

    monkeypatch.setattr(Typestore, "serialize_cdr", refuse)
    sinks, native, ros = Sinks(), Inbox(), Inbox()
    with ExitStack() as stack:
        stack.callback(sinks.close, Deadline())
        sinks.open([kind for kind in SINKS if kind.section in sections], sections, context)
        sinks.start()
        with zenoh.open(client_config(sinks.places()["zenoh"])) as client:
            client.declare_subscriber("corridor/v1/veh1/**", native)
            client.declare_subscriber("3/veh1/**", ros)
            with repeating(put, 0.05):  # what is put before a subscription is known goes nowhere
                for inbox, message in product((native, ros), messages):
                    inbox.wait_for_one(lambda sample, m=message: sample.payload.to_bytes() == m.payload)
            assert sinks.close(Deadline()) == []
    payloads = {message.payload for message in messages}
    assert {sample.payload.to_bytes() for sample in native.samples} == payloads
    assert {sample.payload.to_bytes() for sample in ros.samples} == payloads
    (session,) = sinks.written()["recording"]
    assert {message.payload for message in Recording([session]).messages()} == payloads
