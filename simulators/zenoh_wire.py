"""Puts a fake ROS 2 node on Zenoh: a router of its own on a TCP port, and one topic."""

import json
import logging
import threading
import time
from collections import Counter
from types import TracebackType

import zenoh

from drivers.rmw_zenoh import Attachment, Node, Qos, Topic, make_gid
from drivers.zenoh_config import zenoh_config
from service.encoding import type_hash
from simulators.device import FakeDevice

log = logging.getLogger(__name__)

STOP_TIMEOUT_S = 5.0
OWN_PORT_TIMEOUT_S = 2.0


class ZenohWire:
    """Served while it is entered: entering opens the router, a thread publishes. Port 0: any free one.

    Raises OSError where the port is taken, or the router does not answer.
    """

    def __init__(
        self, device: FakeDevice, topic: str, message_type: str, domain: int, host: str, port: int
    ) -> None:
        self.device = device  # may be replaced by one that wraps it until the wire is entered
        self.counters: Counter[str] = Counter()
        self.failure: BaseException | None = None  # what the device raised; it ends the wire
        self._topic = Topic(topic, message_type, type_hash(message_type))
        self._domain = domain
        self.endpoint = (host, port)  # for port 0 the real one, once entered
        self._stop = threading.Event()
        self._session: zenoh.Session | None = None
        self._thread: threading.Thread | None = None

    def __enter__(self) -> tuple[str, int]:
        self.restore()
        return self.endpoint

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.cut()
        failure, self.failure = self.failure, None
        if failure is not None and error is None:
            raise failure

    def restore(self) -> None:
        """Open and publish, after a cut at the same port."""
        settings = {
            "mode": "router",
            "listen/endpoints": [f"tcp/{self.endpoint[0]}:{self.endpoint[1]}"],
            "scouting/gossip/enabled": True,
            "adminspace/enabled": True,  # reports which port was free
            "transport/shared_memory/enabled": False,
        }
        try:
            self._session = zenoh.open(zenoh_config(settings))
        except zenoh.ZError as error:
            raise OSError(f"no router at {self.endpoint[0]}:{self.endpoint[1]}: {error}") from error
        self.endpoint = (self.endpoint[0], self._own_port(self._session))
        self._stop.clear()
        self._thread = threading.Thread(
            target=self._run, args=(self._session,), name=f"node {self._topic.name}", daemon=True
        )
        self._thread.start()

    def _own_port(self, session: zenoh.Session) -> int:
        for reply in session.get(f"@/{session.zid()}/router", timeout=OWN_PORT_TIMEOUT_S):
            if reply.ok is not None:
                locator: str = json.loads(reply.ok.payload.to_string())["locators"][0]
                return int(locator.rpartition(":")[2])
        session.close()  # type: ignore[no-untyped-call]
        raise OSError(
            f"the fake node's router at {self.endpoint[0]}:{self.endpoint[1]} did not tell its port within "
            f"{OWN_PORT_TIMEOUT_S:g} s; is this machine overloaded? Start it again"
        )

    def cut(self) -> None:
        """End the router and the node."""
        if self._thread is None or self._session is None:
            return
        self._stop.set()
        self._thread.join(STOP_TIMEOUT_S)
        self._session.close()  # type: ignore[no-untyped-call]
        self._thread = self._session = None

    def _run(self, session: zenoh.Session) -> None:
        try:
            self._publish(session)
        except BaseException as error:  # __exit__ raises it
            log.exception("%s: fake node failed", self._topic.name)
            self.failure = error

    def _publish(self, session: zenoh.Session) -> None:
        key, node = self._topic.key(self._domain), Node(self._domain, str(session.zid()), "fake_node")
        gid = make_gid(str(session.zid()), key)
        publisher = session.declare_publisher(key)
        tokens = [
            session.liveliness().declare_token(token)
            for token in (node.token(), node.endpoint_token(1, "MP", self._topic, Qos()))
        ]
        self.device.connected(time.monotonic_ns())
        while tokens:
            due_ns = self.device.next_due_ns(time.monotonic_ns())
            wait_s = None if due_ns is None else max(0.0, (due_ns - time.monotonic_ns()) * 1e-9)
            if self._stop.wait(wait_s):
                break
            if payload := self.device.due(time.monotonic_ns()):
                self.counters["messages"] += 1
                attachment = Attachment(self.counters["messages"], time.time_ns(), gid)
                publisher.put(payload, attachment=attachment.encode())
        self.device.disconnected(time.monotonic_ns())
