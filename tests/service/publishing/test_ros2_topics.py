"""ROS 2 topics over loopback: what a node of rmw_zenoh sees, read with Zenoh alone."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack

import numpy as np
import pytest
import zenoh
import zenoh.ext

from drivers.frames import NO_INTENSITY, LaserScan
from drivers.rmw_zenoh import Attachment
from drivers.zenoh_config import zenoh_config
from service.encoding import (
    ODOMETRY,
    Message,
    decode_grid,
    encode_diagnostics,
    encode_frame,
    encode_pose,
    encode_tf_static,
    type_hash,
)
from service.geometry.se2 import SE2
from service.mapstore.tiles import TileStore
from service.outputs import Grid, TileUpdate
from service.publishing import shared as shared_module
from service.publishing.commands import Answer
from service.publishing.config import PublishingConfig
from service.publishing.ros2_names import TOPICS
from service.publishing.ros2_topics import Ros2Topics
from service.publishing.session import listened_at
from service.publishing.shared import SharedZenoh
from service.publishing.zenoh_publisher import ZenohPublisher
from tests.service.publishing.conftest import Inbox, wait_for_subscriber
from tests.service.test_encoding_outputs import OUTPUT
from tests.system.machine import free_port
from tests.waiting import wait_until

SCAN = LaserScan("front", 1, 1, 1, 1, 0.0, 0.1, 0.0, 1.0, np.ones(2, np.float32), NO_INTENSITY)
POSE_KEY = f"0/pose/nav_msgs::msg::dds_::Odometry_/{type_hash(ODOMETRY)}"
MAP_KEY = "0/map/nav_msgs::msg::dds_::OccupancyGrid_/*"


def config(**ros2: object) -> PublishingConfig:
    return PublishingConfig(listen=("tcp/127.0.0.1:0",), ros2={"enabled": True, **ros2})


class Opened:
    def __init__(self, settings: PublishingConfig, shared: SharedZenoh, store: TileStore) -> None:
        self.topics = Ros2Topics(settings, shared, store, map_period_s=0.05)
        self.endpoint = listened_at(self.topics.session, settings)[0]
        self.zid = str(self.topics.session.zid())


@pytest.fixture
def shared() -> SharedZenoh:
    return SharedZenoh()


@pytest.fixture
def open_topics(shared: SharedZenoh, store: TileStore) -> Iterator[Callable[..., Opened]]:
    with ExitStack() as closed:

        def open_one(settings: PublishingConfig | None = None) -> Opened:
            opened = Opened(settings or config(), shared, store)
            closed.callback(opened.topics.close)
            return opened

        yield open_one


def pose(log_ns: int = 2_000) -> Message:
    return encode_pose(OUTPUT, log_ns)


def tile(version: int) -> TileUpdate:
    return TileUpdate(0, 0, 0, version, 0.05, np.full((64, 64), version, np.int8))


def tokens(client: zenoh.Session, expression: str = "@ros2_lv/**") -> set[str]:
    return {str(reply.ok.key_expr) for reply in client.liveliness().get(expression) if reply.ok is not None}


def test_a_topic_carries_the_bytes_of_the_message_with_its_attachment(open_topics, open_client):
    opened = open_topics()
    inbox = Inbox()
    client = open_client(opened.endpoint)
    client.declare_subscriber(POSE_KEY, inbox)
    wait_for_match(opened, POSE_KEY)
    for log_ns in (2_000, 3_000):
        opened.topics.put(pose(log_ns))
    first, second = inbox.wait_for(2)
    assert first.payload.to_bytes() == pose(2_000).payload
    attachments = [Attachment.decode(sample.attachment.to_bytes()) for sample in (first, second)]
    assert [(a.sequence, a.source_ns) for a in attachments] == [(1, 2_000), (2, 3_000)]
    assert attachments[0].gid == attachments[1].gid != bytes(16)


def wait_for_match(opened: Opened, key: str) -> None:
    wait_for_subscriber(next(p for p in opened.topics._publishers.values() if p.key == key)._publisher)


def test_ten_thousand_messages_have_each_a_well_formed_attachment(open_topics, open_client):
    opened = open_topics()
    seen: list[Attachment] = []
    inbox = Inbox()

    def check(sample: zenoh.Sample) -> None:
        seen.append(Attachment.decode(sample.attachment.to_bytes()))
        inbox(sample)

    open_client(opened.endpoint).declare_subscriber(POSE_KEY, check)
    wait_for_match(opened, POSE_KEY)
    for wave in range(1, 21):  # no more at once than the queue takes
        for number in range(500):
            opened.topics.put(pose(wave * 500 + number))
        inbox.wait_for(wave * 500)
    assert [attachment.sequence for attachment in seen] == list(range(1, 10_001))
    assert [attachment.source_ns for attachment in seen] == list(range(500, 10_500))


def test_the_graph_shows_the_node_and_its_topics_with_quality_of_service(open_topics, open_client):
    opened = open_topics(config(domain=7, namespace="veh1"))
    client = open_client(opened.endpoint)
    begin = f"@ros2_lv/7/{opened.zid}/0"
    hashes = {name: type_hash(kind) for name, kind in TOPICS.items()}
    assert tokens(client) == {
        f"{begin}/0/NN/%/%veh1/corridor",
        f"{begin}/1/MP/%/%veh1/corridor/%veh1%pose/nav_msgs::msg::dds_::Odometry_/{hashes['pose']}/::,10:,:,:,,",
        f"{begin}/2/MP/%/%veh1/corridor/%veh1%odom/nav_msgs::msg::dds_::Odometry_/{hashes['pose']}/::,10:,:,:,,",
        f"{begin}/3/MP/%/%veh1/corridor/%veh1%tf/tf2_msgs::msg::dds_::TFMessage_/{hashes['tf']}/::,100:,:,:,,",
        f"{begin}/4/MP/%/%veh1/corridor/%veh1%tf_static/tf2_msgs::msg::dds_::TFMessage_/{hashes['tf']}/"
        ":1:,1:,:,:,,",
        f"{begin}/5/MP/%/%veh1/corridor/%veh1%map/nav_msgs::msg::dds_::OccupancyGrid_/{hashes['map']}/"
        ":1:,1:,:,:,,",
        f"{begin}/6/MP/%/%veh1/corridor/%veh1%diagnostics/diagnostic_msgs::msg::dds_::DiagnosticArray_/"
        f"{hashes['diagnostics']}/::,10:,:,:,,",
    }


def test_the_topic_of_a_sensor_appears_with_its_first_message(open_topics, open_client):
    opened = open_topics()
    client = open_client(opened.endpoint)
    inbox, key = Inbox(), f"@ros2_lv/0/{opened.zid}/0/*/MP/%/%/corridor/%front%scan/**"
    assert tokens(client, key) == set()
    client.liveliness().declare_subscriber(key, inbox, history=True)  # or one before it is known is missed
    opened.topics.put(encode_frame(SCAN))
    token = str(inbox.wait_for(1)[0].key_expr)
    assert token.split("/")[10:] == [
        "sensor_msgs::msg::dds_::LaserScan_",
        "RIHS01_64c191398013af96509d518dac71d5164f9382553fce5c1f8cca5be7924bd828",
        "::,10:,:,:,,",
    ]


def test_humbles_keys_hold_no_hash(open_topics, open_client):
    opened = open_topics(config(distro="humble"))
    assert {
        token.split("/")[11] for token in tokens(open_client(opened.endpoint), "@ros2_lv/*/*/*/*/MP/**")
    } == {"TypeHashNotSupported"}


def test_closing_takes_node_and_endpoints_out_of_the_graph(open_topics, open_client, shared):
    opened = open_topics()
    shared.open(config())  # as another sink does, which still works
    opened.topics.answer(lambda verb, payload: Answer(True, b"{}"), None)
    client = open_client(opened.endpoint)
    assert len(tokens(client)) == 14  # node, six topics, initialpose, six services
    opened.topics.close()
    list(client.get("behind/what/went/before"))
    assert tokens(client) == set()
    shared.close()


def test_who_comes_late_gets_the_mountings_and_the_map(open_topics, open_client, store):
    opened = open_topics()
    opened.topics.put(encode_tf_static({"front": SE2(0.2, 0.0, 0.0)}, 1, 1))
    store.update([tile(7)])
    opened.topics.map_changed(1_000, 2_000)
    client = open_client(opened.endpoint)
    maps, mountings = Inbox(), Inbox()
    history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
    for key, inbox in ((MAP_KEY, maps), ("0/tf_static/tf2_msgs::msg::dds_::TFMessage_/*", mountings)):
        zenoh.ext.declare_advanced_subscriber(client, key, inbox, history=history)
    assert decode_grid(maps.wait_for(1)[0].payload.to_bytes()).cells.max() == 7
    assert mountings.wait_for(1)[0].attachment is not None


@pytest.fixture
def open_node(open_session) -> Callable[[str], zenoh.Session]:
    """As rmw_zenoh_cpp opens its session by default: a peer with gossip, connected to a router."""

    def open_one(endpoint: str) -> zenoh.Session:
        settings = {
            "mode": "peer",
            "listen/endpoints": ["tcp/127.0.0.1:0"],
            "connect/endpoints": [endpoint],
            "connect/timeout_ms": 20_000,
            "scouting/gossip/enabled": True,
        }
        return open_session(zenoh_config(settings))

    return open_one


def test_nodes_find_each_other_by_this_router(open_topics, open_node):
    """Nodes are peers, and between peers no router carries messages: it only tells them of each other."""
    opened = open_topics()
    talker, listener = open_node(opened.endpoint), open_node(opened.endpoint)
    inbox = Inbox()
    listener.declare_subscriber("0/chatter", inbox)
    publisher = talker.declare_publisher("0/chatter")
    wait_for_subscriber(publisher)
    publisher.put(b"hello")
    assert inbox.wait_for(1)[0].payload.to_bytes() == b"hello"


def test_a_node_gets_the_mountings_again_from_a_restarted_service(open_topics, open_node):
    settings = PublishingConfig(listen=(f"tcp/127.0.0.1:{free_port()}",), ros2={"enabled": True})
    mountings, key = Inbox(), "0/tf_static/tf2_msgs::msg::dds_::TFMessage_/*"
    history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
    opened = open_topics(settings)
    zenoh.ext.declare_advanced_subscriber(open_node(opened.endpoint), key, mountings, history=history)
    for starts in (1, 2):
        opened.topics.put(encode_tf_static({"front": SE2(0.2, 0.0, 0.0)}, 1, 1))
        mountings.wait_for(starts)
        opened.topics.close()
        opened = open_topics(settings)


def test_the_map_is_encoded_once_for_zenoh_and_ros(open_topics, open_client, store, shared, monkeypatch):
    opened = open_topics()
    made = []
    encode_grid = shared_module.encode_grid

    def counted(grid: Grid, *times_ns: int) -> Message:
        made.append((grid.version, *times_ns))
        return encode_grid(grid, *times_ns)

    monkeypatch.setattr(shared_module, "encode_grid", counted)
    settings = config()
    with ZenohPublisher(settings, "veh1", store, picture_period_s=0.05, shared=shared) as publisher:
        client = open_client(opened.endpoint)
        native, ros = Inbox(), Inbox()
        client.declare_subscriber("corridor/v1/veh1/map", native)
        client.declare_subscriber(MAP_KEY, ros)
        for version in (1, 2, 3):
            store.update([tile(version)])
            publisher.map_changed([tile(version)], version, version)
            opened.topics.map_changed(version, version)
            first, second = (payload_sent_at(inbox, version) for inbox in (native, ros))
            assert first == second
            assert decode_grid(first).cells.max() == version
    assert len(made) == len(set(made))


def payload_sent_at(inbox: Inbox, log_ns: int) -> bytes:
    """Waits for it."""
    sent = inbox.wait_for_one(lambda s: Attachment.decode(s.attachment.to_bytes()).source_ns == log_ns)
    return sent.payload.to_bytes()


def test_what_cannot_be_sent_is_counted_and_the_rest_goes_on(open_topics, open_client):
    opened = open_topics()
    inbox = Inbox()
    open_client(opened.endpoint).declare_subscriber(POSE_KEY, inbox)
    wait_for_match(opened, POSE_KEY)
    opened.topics.put(encode_diagnostics("a//b", [], 1, 1))  # no key of Zenoh
    opened.topics.put(pose())
    inbox.wait_for(1)
    opened.topics.close()
    assert opened.topics.counts()["failed"] == {"a//b": 1}
    assert opened.topics.counts()["sent"] == {"pose": 1}


def test_a_map_that_cannot_be_encoded_is_counted_and_the_next_one_is_sent(
    open_topics, open_client, store, monkeypatch
):
    encode_grid, fails = shared_module.encode_grid, iter([True])

    def failing(*args: object) -> Message:
        if next(fails, False):
            raise ValueError("no such grid")
        return encode_grid(*args)

    monkeypatch.setattr(shared_module, "encode_grid", failing)
    opened, maps = open_topics(), Inbox()
    store.update([tile(7)])
    open_client(opened.endpoint).declare_subscriber(MAP_KEY, maps)
    wait_until(lambda: opened.topics.counts()["failed"] == {"map": 1})  # asked for by the subscription
    opened.topics.map_changed(1_000, 2_000)
    assert maps.wait_for(1)
