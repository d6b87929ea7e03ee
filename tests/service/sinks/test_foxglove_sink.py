"""Against a client that is not the SDK's: foxglove.sdk.v1 over aiohttp, messages read by rosbags."""

import asyncio
import json
import re
import socket
import struct
import sys
import threading
from collections.abc import Awaitable, Callable, Iterator
from typing import Any

import aiohttp
import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from service.encoding import ERROR, OK, encode_tf_static
from service.errors import StorageError
from service.geometry.se2 import SE2
from service.mapstore.tiles import TileStore
from service.outputs import TileUpdate
from service.sinks.foxglove_config import FoxgloveConfig
from service.sinks.foxglove_sink import MAX_WAITING, FoxgloveSink, open_sink
from service.sinks.sink import SinkContext
from tests.browser.scene import Scene, event
from tests.http_client import client_session
from tests.service.sinks.contexts import sink_context
from tests.waiting import wait_until

TIMEOUT_S = 20.0
JAZZY = get_typestore(Stores.ROS2_JAZZY)


@pytest.fixture
def open_one() -> Iterator[Callable[..., FoxgloveSink]]:
    opened: list[FoxgloveSink] = []

    def start(listen: str = "127.0.0.1:0", **context: Any) -> FoxgloveSink:
        sink = FoxgloveSink(FoxgloveConfig(enabled=True, listen=listen), sink_context(**context), 0.05)
        opened.append(sink)
        return sink

    yield start
    for sink in opened:
        sink.close()


class Viewer:
    """Subscribes to topics, and reads what comes of them."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self._socket = socket
        self.channels: dict[str, dict[str, Any]] = {}  # by topic
        self._came: list[tuple[str, int, Any]] = []  # topic, log time, message
        self._wanted = ""  # the subscription

    async def wait_for_topics(self, *topics: str) -> None:
        while not {*topics} <= self.channels.keys():
            await self._receive()

    async def subscribe(self, *topics: str) -> None:
        await self.wait_for_topics(*topics)
        wanted = [{"id": 100 + self.channels[t]["id"], "channelId": self.channels[t]["id"]} for t in topics]
        self._wanted = json.dumps({"op": "subscribe", "subscriptions": wanted})
        await self._socket.send_str(self._wanted)

    async def next(self, topic: str) -> tuple[int, Any]:
        while True:
            for k, (came, log_ns, message) in enumerate(self._came):
                if came == topic:
                    del self._came[k]
                    return log_ns, message
            await self._receive()

    async def _receive(self) -> None:
        message = await self._socket.receive(TIMEOUT_S)
        if message.type is aiohttp.WSMsgType.TEXT:
            facts = json.loads(message.data)
            if facts["op"] == "advertise":
                self.channels |= {channel["topic"]: channel for channel in facts["channels"]}
            elif facts["op"] == "status" and "Unknown channel" in facts["message"]:
                # The SDK advertises a channel a moment before it lets anybody subscribe to it.
                await self._socket.send_str(self._wanted)
            return
        assert message.type is aiohttp.WSMsgType.BINARY, message
        opcode, subscription, log_ns = struct.unpack_from("<BIQ", message.data)
        assert opcode == 1
        channel = next(c for c in self.channels.values() if c["id"] == subscription - 100)
        content = JAZZY.deserialize_cdr(message.data[13:], channel["schemaName"])
        self._came.append((channel["topic"], log_ns, content))


def talk(sink: FoxgloveSink, conversation: Callable[[Viewer], Awaitable[None]]) -> None:
    wait_until(sink.place, words="it serves no client")

    async def hold() -> None:
        async with (
            asyncio.timeout(TIMEOUT_S),
            client_session() as session,
            session.ws_connect(sink.place(), protocols=["foxglove.sdk.v1"], max_msg_size=0) as socket,
        ):
            await conversation(Viewer(socket))

    asyncio.run(hold())


def test_a_viewer_gets_what_a_recording_would_hold(open_one: Callable[..., FoxgloveSink]) -> None:
    scene, sink = Scene(), open_one()
    for message in scene.messages(1.0):
        sink.put(message)
    sink.put(event("{}", 1.0))

    async def look(viewer: Viewer) -> None:
        await viewer.wait_for_topics("/pose", "/front/scan", "/diagnostics", "/tf_static", "/events")
        pose = viewer.channels["/pose"]
        assert (pose["encoding"], pose["schemaEncoding"]) == ("cdr", "ros2msg")
        assert pose["schemaName"] == "nav_msgs/msg/Odometry"
        assert pose["schema"] == JAZZY.generate_msgdef("nav_msgs/msg/Odometry", ros_version=2)[0]
        await viewer.subscribe("/pose", "/tf_static")
        _, transforms = await viewer.next("/tf_static")  # put long before, and kept
        assert {edge.child_frame_id for edge in transforms.transforms} == {"front", "rear"}
        message = scene.messages(2.0)[1]
        sink.put(message)
        log_ns, odometry = await viewer.next("/pose")
        assert log_ns == message.log_ns
        assert odometry.pose.pose.position.x == scene.pose(2.0).x_m
        assert (sink.health().level, sink.health().values["subscriptions"]) == (OK, "2")

    talk(sink, look)


def test_the_map_is_there_for_who_comes_late_and_again_when_it_changes(
    open_one: Callable[..., FoxgloveSink],
) -> None:
    store = TileStore()
    sink = open_one(tiles=store)
    store.update([TileUpdate(0, 0, 0, 1, 0.05, np.full((64, 64), 7, np.int8))])

    async def look(viewer: Viewer) -> None:
        await viewer.subscribe("/map")
        _, grid = await viewer.next("/map")
        assert (grid.info.width, set(grid.data.tolist())) == (64, {7})
        store.update([TileUpdate(0, 1, 0, 2, 0.05, np.full((64, 64), 9, np.int8))])
        while grid.info.width == 64:  # it comes twice to who subscribes between its channel and itself
            _, grid = await viewer.next("/map")
        assert (grid.info.width, set(grid.data.tolist())) == (128, {7, 9})

    talk(sink, look)


def test_nothing_waits_while_the_port_is_taken_and_it_is_had_when_it_is_free(
    open_one: Callable[..., FoxgloveSink],
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        sink = open_one(f"127.0.0.1:{port}")
        wait_until(lambda: "cannot be served" in sink.health().message)
        assert sink.health().level == ERROR
        assert sink.health().values["reason_id"] == "not_served"
        sink.put(encode_tf_static({"front": SE2()}, 1, 1))
        for k in range(MAX_WAITING + 500):
            sink.put(event("{}", k * 1e-3))

    async def look(viewer: Viewer) -> None:
        await viewer.subscribe("/tf_static")
        assert (await viewer.next("/tf_static"))[1].transforms

    talk(sink, look)
    assert sink.health().level == OK


def test_it_ends_also_where_it_never_had_its_port(open_one: Callable[..., FoxgloveSink]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        open_one(f"127.0.0.1:{other.getsockname()[1]}").close()
    assert "foxglove-send" not in {thread.name for thread in threading.enumerate()}


def test_without_the_package_the_config_is_refused_in_words(monkeypatch: pytest.MonkeyPatch) -> None:
    context: SinkContext = sink_context()
    assert open_sink(FoxgloveConfig(), context) is None
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(StorageError, match=re.escape("-m pip install 'foxglove-sdk<")):
        open_sink(FoxgloveConfig(enabled=True), context)
