"""The wire to a ROS 2 node: a subscription on Zenoh, visible in the graph as one."""

import threading
from collections import deque

import zenoh

from drivers.errors import TransportError
from drivers.rmw_zenoh import NO_TYPE_HASH, Node, Qos, Topic
from drivers.transport import Transport
from drivers.zenoh_config import zenoh_config
from service.encoding import type_hash
from service.ros2_sensors.config import Ros2SensorConfig
from service.ros2_sensors.session import pack

CONNECT_TIMEOUT_MS = 3_000
MAX_WAITING = 1000  # messages; 5 s of an IMU


class Subscription(Transport):
    """A transport that only reads. Raises TransportError where the router is not there, messages are lost, or
    messages of another definition come.

    It does not notice that the router goes: silence does.
    """

    def __init__(self, config: Ros2SensorConfig, message_type: str) -> None:
        self._where = f"{config.topic} at {config.router}"
        self._changed = threading.Condition()
        self._waiting: deque[bytes] = deque()
        self._lost = 0
        self._hash = type_hash(message_type)
        self._foreign_hash = ""  # of a message that came and is not read
        settings = {
            "mode": "client",
            "connect/endpoints": [config.router],
            "connect/timeout_ms": CONNECT_TIMEOUT_MS,
            "transport/shared_memory/enabled": False,
        }
        try:
            self._session = zenoh.open(zenoh_config(settings))
        except zenoh.ZError as error:
            raise TransportError(
                f"cannot connect to the router {config.router}: nothing answers there; start corridor or "
                "rmw_zenohd on that machine"
            ) from error
        node = Node(config.domain, str(self._session.zid()), f"corridor_{config.name}")
        topic = Topic(config.topic, message_type, self._hash)
        any_hash = Topic(config.topic, message_type, "*")
        taken = zenoh.handlers.Callback(self._take, indirect=False)
        self._declared = [
            self._session.declare_subscriber(any_hash.key(config.domain), taken),
            *(
                self._session.liveliness().declare_token(key)
                for key in (node.token(), node.endpoint_token(1, "MS", topic, Qos()))
            ),
        ]

    def read(self, timeout_s: float) -> bytes:
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._foreign_hash, timeout_s)
            messages, self._waiting = self._waiting, deque()
            lost, self._lost = self._lost, 0
            foreign_hash, self._foreign_hash = self._foreign_hash, ""
        if foreign_hash:
            raise TransportError(
                f"{self._where}: messages with type hash {foreign_hash} come; expected {self._hash}; build "
                "the node that publishes them with the messages of its ROS 2 distribution"
            )
        if lost:
            lost += len(messages)  # these are not read either
            raise TransportError(f"{self._where}: {lost} messages lost, they were not read in time")
        return b"".join(map(pack, messages))

    def write(self, data: bytes) -> None:
        raise TransportError(f"{self._where}: a subscription takes no {len(data)} bytes")

    def close(self) -> None:
        self._session.close()  # type: ignore[no-untyped-call]

    def _take(self, sample: zenoh.Sample) -> None:
        """Zenoh's thread: keep it until it is read."""
        hash_text = str(sample.key_expr).rpartition("/")[2]
        with self._changed:
            if hash_text not in (self._hash, NO_TYPE_HASH):  # Humble's publishers have none
                self._foreign_hash = hash_text
                self._changed.notify()
                return
            if len(self._waiting) >= MAX_WAITING:
                self._waiting.popleft()
                self._lost += 1
            self._waiting.append(sample.payload.to_bytes())
            self._changed.notify()
