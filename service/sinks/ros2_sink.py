"""Topics and services for ROS 2 nodes on rmw_zenoh, as a sink."""

from collections.abc import Sequence

from service.encoding import WARNING, Message, Status
from service.outputs import TileUpdate
from service.publishing.config import PublishingConfig
from service.publishing.ros2_names import MAP, OF_SENSORS, TOPICS
from service.publishing.ros2_topics import Ros2Topics
from service.publishing.shared import SharedZenoh
from service.sinks.counted_row import counted_row
from service.sinks.sink import Sink, SinkContext


def open_sink(config: PublishingConfig, context: SinkContext) -> "Ros2Sink | None":
    """Raises StorageError where Zenoh cannot listen."""
    return Ros2Sink(config, context) if config.ros2.enabled else None


class Ros2Sink(Sink):
    """Sends from the moment it is constructed; answers from `start` on."""

    name = "ros2"

    def __init__(self, config: PublishingConfig, context: SinkContext) -> None:
        self._context = context
        self._place = f"domain {config.ros2.domain}, {config.ros2.namespace or '/'}"
        self._routers = ", ".join(config.connect) if config.ros2.router == "connect" else ""
        self.topics = Ros2Topics(config, context.shared.of(SharedZenoh), context.tiles)

    def start(self) -> None:
        self.topics.answer(self._context.command, self._context.folders.get("map"))

    def put(self, message: Message, arrived_ns: int | None = None) -> None:
        sensor, _, last = message.channel.rpartition("/")
        if (last in OF_SENSORS) if sensor else (last in TOPICS and last != MAP):
            self.topics.put(message)

    def put_tiles(self, tiles: Sequence[TileUpdate], stamp_ns: int, log_ns: int) -> None:
        self.topics.map_changed(stamp_ns, log_ns)

    def health(self) -> Status:
        refused = self.topics.pose_refused
        row = counted_row(self.name, self.topics.counts(), {"initialpose_refused": refused})
        if self._routers and not self.topics.has_router:
            no_router = f"no router at {self._routers}; start rmw_zenohd there, or change publishing.connect"
            return row._replace(level=WARNING, message=no_router)
        return row

    def place(self) -> str:
        return self._place

    def close(self) -> None:
        self.topics.close()
