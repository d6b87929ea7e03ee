"""Publishes messages and the map to ROS 2 nodes that run rmw_zenoh_cpp. Mapping and drivers never wait.

What is sent are the bytes that go to subscribers of the native keys and into recordings, on other keys.
"""

from collections import Counter
from functools import partial
from pathlib import Path

from drivers.rmw_zenoh import Qos
from service.encoding import Message
from service.encoding.wire import INITIAL_POSE
from service.publishing import initial_pose
from service.publishing.config import PublishingConfig
from service.publishing.initial_pose import InitialPoseSubscriber
from service.publishing.listeners import Listeners
from service.publishing.ros2_names import MAP, TOPICS
from service.publishing.ros2_node import Ros2Node, Ros2Publisher
from service.publishing.ros2_services import Command, Ros2Services
from service.publishing.send_queues import Bulk, Sending
from service.publishing.senders import Senders
from service.publishing.shared import GridSource, SharedZenoh

MAP_PERIOD_S = 1.0

LATCHED = Qos(depth=1, is_transient_local=True)
QOS = {MAP: LATCHED, "tf_static": LATCHED, "tf": Qos(depth=100)}  # of others: the default


class Ros2Topics:
    """All topics, the subscription to initial poses, and the services; open when constructed.

    Raises StorageError where Zenoh cannot listen.
    """

    def __init__(
        self,
        config: PublishingConfig,
        shared: SharedZenoh,
        map_source: GridSource,
        map_period_s: float = MAP_PERIOD_S,
    ) -> None:
        self._map = shared.map_picture(map_source)
        self._senders = Senders("ros2", map_period_s, map_period_s)
        self.initial_pose: InitialPoseSubscriber | None = None
        self._services: Ros2Services | None = None
        self.session = shared.open(config)
        self._senders.opened.callback(shared.close)
        try:
            self._node = Ros2Node(self.session, config.ros2)
            self._senders.opened.callback(self._node.close)
            self._publishers = {channel: self._declare(channel, kind) for channel, kind in TOPICS.items()}
            map_key = self._publishers[MAP].key
            requested = partial(self._senders.bulk.ask_for, MAP)
            self._map_listeners = Listeners(self.session, map_key, requested)
        except BaseException:
            self._senders.close()
            raise
        self._senders.start(self._send_queued, self._send_due)

    def put(self, message: Message) -> None:
        """Hand a message over: sent 10 ms later at most. A full queue drops its oldest, counted."""
        self._senders.stream.put(Sending(message, None))

    def map_changed(self, stamp_ns: int, log_ns: int) -> None:
        """Send the complete map soon, if there is a subscriber; Unix time of the newest scan in it."""
        self._map.changed(stamp_ns, log_ns)
        self._senders.bulk.ask_for(MAP)

    def answer(self, command: Command, map_folder: Path | None) -> None:
        """Take poses on initialpose, and answer services, from now on. `command` may wait a bounded time."""
        key = self._node.subscription_key(initial_pose.CHANNEL, INITIAL_POSE)
        self.initial_pose = InitialPoseSubscriber(self.session, key, command, owner="ros2")
        self._senders.opened.callback(self.initial_pose.close)
        self._services = Ros2Services(self._node, command, self._present_map, map_folder)
        self._senders.opened.callback(self._services.close)

    @property
    def pose_refused(self) -> str:
        """Why the newest pose on initialpose was not taken, "" if it was."""
        return self.initial_pose.refused if self.initial_pose is not None else ""

    @property
    def has_router(self) -> bool:
        """Whether another router is connected."""
        return bool(self.session.info.routers_zid())

    def counts(self) -> dict[str, Counter[str]]:
        """Messages sent, dropped and failed, by channel; requests answered, by service."""
        answered = Counter[str]() if self._services is None else self._services.counts()
        return self._senders.counts() | {"answered": answered}

    def close(self) -> None:
        """Send what waits, then leave the graph. A second call does nothing."""
        self._senders.close()

    def _send_queued(self, sending: Sending) -> None:
        self._senders.attempt(sending.message.channel, partial(self._send, sending.message))

    def _send_due(self, _: Bulk) -> None:
        self._senders.attempt(MAP, self._send_map)

    def _send_map(self) -> None:
        if self._map_listeners.are_there and (message := self._present_map()) is not None:
            self._send(message)

    def _present_map(self) -> Message | None:
        picture = self._map.message()
        return None if picture is None else picture[0]

    def _send(self, message: Message) -> None:
        channel = message.channel
        publisher = self._publishers.get(channel)
        if publisher is None:
            publisher = self._publishers[channel] = self._declare(channel, message.type)
        publisher.put(message.payload, message.log_ns)
        self._senders.count(channel)

    def _declare(self, channel: str, message_type: str) -> Ros2Publisher:
        return self._node.publisher(channel, message_type, QOS.get(channel, Qos()))
