"""The router of a site: ours, or the config of a zenohd."""

import json
import resource
from typing import Any

import zenoh

from service.publishing.config import PublishingConfig
from service.publishing.session import open_session, router_settings

MAX_VEHICLES = 10_000
FILES_BESIDES = 200  # that the process opens, besides one a session


def start_router(config: PublishingConfig) -> zenoh.Session:
    """With as many sessions as the process may open files. Raises StorageError where it cannot listen."""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    return open_session(config, min(most - FILES_BESIDES, MAX_VEHICLES))


def zenohd_config(config: PublishingConfig) -> str:
    """The same as JSON, which zenohd reads. Raises StorageError as router_settings."""
    settings = {"scouting/multicast/enabled": False, **router_settings(config, MAX_VEHICLES)}
    nested: dict[str, Any] = {}
    for path, value in settings.items():
        *parents, name = path.split("/")
        part = nested
        for parent in parents:
            part = part.setdefault(parent, {})
        part[name] = value
    return json.dumps(nested, indent=1, default=str) + "\n"
