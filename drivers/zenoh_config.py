"""Settings of a Zenoh session from Python values."""

import json
from collections.abc import Mapping
from typing import Any

import zenoh


def zenoh_config(values: Mapping[str, Any]) -> zenoh.Config:
    """values: by path, for example "listen/endpoints". Multicast scouting is off. Raises ZError."""
    config = zenoh.Config()
    for path, value in {"scouting/multicast/enabled": False, **values}.items():
        config.insert_json5(path, json.dumps(value))
    return config
