"""What a service offers its sinks, as far as a test cares."""

import time
from typing import Any

from service.mapstore.tiles import TileStore
from service.publishing.commands import Answer
from service.sinks.sink import SinkContext


def sink_context(**parts: Any) -> SinkContext:
    defaults: dict[str, Any] = {
        "vehicle": "veh1",
        "profile": "corridor",
        "stores_graph": False,
        "is_localizing": False,
        "start_unix_ns": 1_700_000_000_000_000_000,
        "load_version": None,
        "map_folder": None,
        "folders": {},
        "metadata": {},
        "tiles": TileStore(),
        "links": {},
        "command": lambda verb, payload: Answer(True, b"{}"),
        "verbs": lambda: ["mark"],
        "emit": lambda message: None,
        "unix_ns": time.time_ns,
        "is_paused": lambda: False,
        "present_profile": lambda: "corridor",
        "pose_sent": lambda duration_ns: None,
    }
    return SinkContext(**(defaults | parts))
