"""A site's router on loopback, vehicles' sinks at it, and clients of each role."""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import zenoh

from service.encoding import OK, Status, encode_diagnostics
from service.publishing.config import PublishingConfig
from service.publishing.session import open_session as open_router
from service.sinks.fleet_sink import FleetSink, open_sink
from tests.service.publishing.conftest import client_of, open_client, open_session, site, tls
from tests.service.sinks.contexts import sink_context
from tests.system.machine import free_port
from tests.waiting import wait_until

__all__ = ["client_of", "open_client", "open_session", "site"]
ROLES = {"viewer": ["viewer"], "operator": ["operator"], "vehicle": ["veh1", "veh2"]}


def router_config(site: Path, endpoint: str) -> PublishingConfig:
    """Of a router with the certificate of veh2, which is that of this machine."""
    security = {"tls": tls(site, "veh2"), "roles": ROLES} if endpoint.startswith("tls") else "none"
    return PublishingConfig.model_validate({"listen": (endpoint,), "security": security})


@pytest.fixture
def start_router(site) -> Iterator[Callable[..., zenoh.Session]]:
    with ExitStack() as opened:

        def start(endpoint: str) -> zenoh.Session:
            session = open_router(router_config(site, endpoint))
            opened.callback(session.close)
            return session

        yield start


@pytest.fixture
def endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture
def site_file(tmp_path, endpoint) -> str:
    """For --site."""
    path = tmp_path / "site.yaml"
    path.write_text(f"publishing: {{connect: [{endpoint}]}}\n")
    return str(path)


@pytest.fixture
def router(start_router, endpoint) -> zenoh.Session:
    return start_router(endpoint)


@pytest.fixture
def client(router, endpoint, open_client) -> zenoh.Session:
    return open_client(endpoint)


@pytest.fixture
def start_vehicle(site) -> Iterator[Callable[..., FleetSink]]:
    with ExitStack() as opened:

        def start(endpoint: str, vehicle: str = "veh1", waits: bool = True, **parts: Any) -> FleetSink:
            fleet = {"connect": (endpoint,), **parts.pop("fleet", {})}
            certificate = parts.pop("certificate", vehicle)
            security = {"tls": tls(site, certificate)} if endpoint.startswith("tls") else "none"
            config = PublishingConfig.model_validate({"fleet": fleet, "security": security})
            sink = open_sink(config, sink_context(vehicle=vehicle, **parts))
            opened.callback(sink.close)
            sink.start()
            if waits:
                wait_until(lambda: is_in_fleet(sink), words=f"{vehicle} is not in the fleet")
            return sink

        yield start


def is_in_fleet(sink: FleetSink) -> bool:
    return sink._publisher is not None


def diagnostics(state: str = "ok", stamp_ns: int | None = None, level: int = OK):
    """stamp_ns   None: now
    level      of the status mapping
    """
    stamp_ns = time.time_ns() if stamp_ns is None else stamp_ns
    rows = [
        Status("mapping", level, state, {"state": state}),
        Status("recording", OK, "recording", {"free_gb": "12.5"}),
        Status("map", OK, "ok", {"folder": "/maps/site", "saved_version": "3"}),
        Status("fleet", OK, "ok", {"corridor": "0.1.0", "map_version": "7"}),
    ]
    return encode_diagnostics("diagnostics", rows, stamp_ns, stamp_ns)
