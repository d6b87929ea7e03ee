"""The kinds of sinks: the section of the config and the opener of each. One line per sink.

The config models are imported with the config; what opens a sink, only when the service starts.
"""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel

if TYPE_CHECKING:
    from service.sinks.sink import Sink, SinkContext


@dataclass(frozen=True, slots=True)
class SinkKind:
    """How one kind of sink is configured and opened; `module:name` each.

    section   key of the config
    model     config model of that section; a section left out is read as {}
    opener    takes the model and a SinkContext; gives a Sink, or None where the section switches it off
    """

    section: str
    model: str
    opener: str

    def load_model(self) -> type[BaseModel]:
        """The config model."""
        model: type[BaseModel] = _load(self.model)
        return model

    def open_sink(self, section: BaseModel, context: "SinkContext") -> "Sink | None":
        """Raises StorageError where the sink cannot be opened."""
        opener: Callable[[Any, SinkContext], Sink | None] = _load(self.opener)
        return opener(section, context)


_PUBLISHING = "service.publishing.config:PublishingConfig"
# In the order in which they start: the map before the recording, for a start that it refuses leaves none.
SINKS = (
    SinkKind("publishing", _PUBLISHING, "service.sinks.zenoh_sink:ZenohSink"),
    SinkKind("publishing", _PUBLISHING, "service.sinks.ros2_sink:open_sink"),
    SinkKind("publishing", _PUBLISHING, "service.sinks.fleet_sink:open_sink"),
    SinkKind("map", "service.mapstore.config:MapConfig", "service.sinks.map_saver:MapSaver"),
    SinkKind("recording", "service.recording.config:RecordingConfig", "service.sinks.mcap_sink:McapSink"),
    SinkKind("web", "service.web.config:WebConfig", "service.sinks.web_sink:open_sink"),
    SinkKind(
        "foxglove", "service.sinks.foxglove_config:FoxgloveConfig", "service.sinks.foxglove_sink:open_sink"
    ),
)


def _load(address: str) -> Any:
    module, _, name = address.partition(":")
    return getattr(import_module(module), name)
