"""A node of ROS 2's graph on a Zenoh session: publishers, subscriptions and services with their tokens."""

import time
from collections.abc import Callable

import zenoh
import zenoh.ext

from drivers.rmw_zenoh import NO_TYPE_HASH, Attachment, EndpointKind, Node, Qos, Topic, make_gid
from drivers.zenoh_callback import daemon_callback
from service.encoding import type_hash
from service.encoding.ros_services import service_hash
from service.publishing.config import Ros2Config

NODE_NAME = "corridor"


class Ros2Publisher:
    """Of one topic; one thread puts."""

    def __init__(self, session: zenoh.Session, key: str, gid: bytes, qos: Qos) -> None:
        self.key = key
        self._gid = gid
        self._sequence = 0
        self._publisher = (
            zenoh.ext.declare_advanced_publisher(
                session,
                key,
                congestion_control=zenoh.CongestionControl.DROP,
                cache=zenoh.ext.CacheConfig(max_samples=qos.depth),
                publisher_detection=True,
            )
            if qos.is_transient_local
            else session.declare_publisher(key, congestion_control=zenoh.CongestionControl.DROP)
        )

    def put(self, payload: bytes, source_ns: int) -> None:
        """source_ns: Unix time at which the service had it. Raises ZError."""
        self._sequence += 1
        attachment = Attachment(self._sequence, source_ns, self._gid)
        self._publisher.put(payload, attachment=attachment.encode())


class Ros2Node:
    """Visible in the graph from its construction until `close`. Raises ZError where Zenoh refuses a key."""

    def __init__(self, session: zenoh.Session, config: Ros2Config) -> None:
        self._session = session
        self._config = config
        self._node = Node(config.domain, str(session.zid()), NODE_NAME, config.namespace)
        self._endpoints = 0
        self._tokens = [session.liveliness().declare_token(self._node.token())]
        self._queryables: list[zenoh.Queryable[None]] = []

    def publisher(self, name: str, message_type: str, qos: Qos) -> Ros2Publisher:
        """name: without the namespace and without a leading slash, "front/scan"."""
        topic = self._topic(name, message_type, type_hash(message_type))
        key = topic.key(self._config.domain)
        publisher = Ros2Publisher(self._session, key, make_gid(self._node.session_id, key), qos)
        self._declare("MP", topic, qos)
        return publisher

    def subscription_key(self, name: str, message_type: str) -> str:
        """Declares a subscription; the caller takes the samples of its key."""
        topic = self._topic(name, message_type, type_hash(message_type))
        self._declare("MS", topic, Qos())
        return topic.key(self._config.domain)

    def service(self, name: str, service_type: str, take: Callable[[zenoh.Query], None]) -> None:
        """name: below the node, "pause". `take` is called in a thread of its own; `reply` answers."""
        topic = self._topic(f"{NODE_NAME}/{name}", service_type, service_hash(service_type))
        key = topic.key(self._config.domain)
        taken = daemon_callback(take, f"ros2-service-{name}")
        self._queryables.append(self._session.declare_queryable(key, taken, complete=True))
        self._declare("SS", topic, Qos())

    def take_no_more_requests(self) -> None:
        while self._queryables:
            self._queryables.pop().undeclare()  # type: ignore[no-untyped-call]

    def close(self) -> None:
        """Leave the graph; the endpoints first."""
        while self._tokens:
            self._tokens.pop().undeclare()  # type: ignore[no-untyped-call]

    def _topic(self, name: str, type_name: str, hash_text: str) -> Topic:
        has_hashes = self._config.distro != "humble"
        return Topic(f"{self._config.namespace}/{name}", type_name, hash_text if has_hashes else NO_TYPE_HASH)

    def _declare(self, kind: EndpointKind, topic: Topic, qos: Qos) -> None:
        self._endpoints += 1
        token = self._node.endpoint_token(self._endpoints, kind, topic, qos)
        self._tokens.append(self._session.liveliness().declare_token(token))


def request_of(query: zenoh.Query) -> Attachment:
    """Attachment by which the client recognises its request. Raises ValueError where it is missing."""
    if query.attachment is None:
        raise ValueError("a request without an attachment; expected 33 bytes with sequence, time and gid")
    return Attachment.decode(query.attachment.to_bytes())


def reply(query: zenoh.Query, request: Attachment, payload: bytes) -> None:
    """Raises ZError."""
    response = Attachment(request.sequence, time.time_ns(), request.gid)
    query.reply(query.key_expr, payload, attachment=response.encode())
