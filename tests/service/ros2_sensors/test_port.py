"""Over loopback: a fake node on a router, the link of all drivers, and the subscription."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

import pytest
import zenoh

from drivers.errors import TransportError
from drivers.link import LinkHealth, run_link
from drivers.rmw_zenoh import Topic
from service.encoding import LASER_SCAN, encode_frame
from service.ros2_sensors import port as port_module
from service.ros2_sensors.port import Subscription
from service.ros2_sensors.scan import KIND
from simulators.ros2_node import FakeNode, NodeSetup
from simulators.zenoh_wire import ZenohWire
from tests.in_background import in_background
from tests.service.publishing.conftest import TIMEOUT_S, Inbox, client_config, wait_for_subscriber
from tests.service.ros2_sensors.nodes import config, scan
from tests.system.machine import free_port
from tests.waiting import wait_until

SETUP = NodeSetup(20_000_000)


@pytest.fixture
def wire() -> Iterator[ZenohWire]:
    served = ZenohWire(FakeNode(scan, SETUP), "/scan", LASER_SCAN, 0, "127.0.0.1", 0)
    with served:
        yield served


def router_of(wire: ZenohWire) -> str:
    return f"tcp/{wire.endpoint[0]}:{wire.endpoint[1]}"


@contextmanager
def link(settings: object, heard: Inbox) -> Iterator[LinkHealth]:
    health = LinkHealth("laser")
    ends = partial(KIND.open_transport, settings), KIND.session_maker(settings)
    with in_background(partial(run_link, health, *ends, heard)):
        yield health


def test_the_scans_of_a_node_arrive(wire: ZenohWire):
    heard = Inbox()
    with link(config(router=router_of(wire)), heard) as health:
        heard.wait_for(5)
        assert (health.state, health.status) == ("streaming", "streaming")
        assert health.identity == {"frame": "laser"}
    stamps_ns = [frame.stamp_ns for frame in heard.samples]
    assert stamps_ns == sorted(stamps_ns)
    assert wire.counters["messages"] >= 5


def test_it_goes_on_when_the_router_was_restarted(wire: ZenohWire):
    heard = Inbox()
    with link(config(router=router_of(wire), silence_timeout_s=0.5), heard) as health:
        heard.wait_for(2)
        wire.cut()
        wire.restore()
        heard.wait_for(len(heard.samples) + 20)  # more than can have been in transit
        assert health.state == "streaming"


PAYLOAD = encode_frame(scan(1)).payload


@contextmanager
def published(wire: ZenohWire, hash_text: str) -> Iterator[Subscription]:
    """A subscription to a topic on which there is one message, its type hash as it says."""
    key = Topic("/other", LASER_SCAN, hash_text).key(0)
    with (
        Subscription(config(router=router_of(wire), topic="/other"), LASER_SCAN) as heard,
        zenoh.open(client_config(router_of(wire))) as session,
    ):
        publisher = session.declare_publisher(key)
        wait_for_subscriber(publisher)
        publisher.put(PAYLOAD)
        yield heard


def test_messages_with_another_type_hash_are_refused_with_both_hashes(wire: ZenohWire):
    expected = r"/other at .* type hash RIHS01_0a come; expected RIHS01_64c1\w+; build the node"
    with published(wire, "RIHS01_0a") as heard, pytest.raises(TransportError, match=expected):
        heard.read(TIMEOUT_S)


def test_no_router_is_a_transport_error():
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with pytest.raises(TransportError, match=f"cannot connect to the router {endpoint}: nothing answers"):
        Subscription(config(router=endpoint), LASER_SCAN)


def test_messages_that_are_not_read_in_time_are_no_silent_loss(wire: ZenohWire, monkeypatch):
    monkeypatch.setattr(port_module, "MAX_WAITING", 2)
    with Subscription(config(router=router_of(wire)), LASER_SCAN) as subscription:
        wait_until(lambda: wire.counters["messages"] >= 20)
        monkeypatch.undo()  # a busy machine loses no more of them between the two reads
        with pytest.raises(TransportError, match=r"/scan at tcp/.*: \d+ messages lost") as raised:
            subscription.read(1.0)
        assert int(str(raised.value).split()[3]) >= 5  # with the two that still waited
        assert subscription.read(TIMEOUT_S)
