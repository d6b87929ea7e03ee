"""ROS 2 topics over loopback: what a node of rmw_zenoh sees, read with Zenoh alone."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack

import numpy as np
import pytest
import zenoh
import zenoh.ext

from drivers.frames import NO_INTENSITY, LaserScan
from drivers.rmw_zenoh import Attachment
from service.encoding import (
    ODOMETRY,
    Message,
    decode_grid,
    encode_diagnostics,
    encode_pose,
    encode_tf_static,
    type_hash,
)
from service.geometry.se2 import SE2
from service.mapstore.tiles import TileStore
from service.outputs import TileUpdate
from service.publishing.config import PublishingConfig
from service.publishing.ros2_names import TOPICS
from service.publishing.ros2_topics import Ros2Topics
from service.publishing.session import listened_at
from service.publishing.shared import SharedZenoh
from tests.service.publishing.conftest import Inbox, wait_for_subscriber
from tests.service.test_encoding_outputs import OUTPUT

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


def tokens(client: zenoh.Session) -> set[str]:
    return {
        str(reply.ok.key_expr) for reply in client.liveliness().get("@ros2_lv/**") if reply.ok is not None
    }


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
