"""Opens the Zenoh session; an error names the reason."""

import json
import os
import re
import socket
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import zenoh

from drivers.zenoh_config import zenoh_config
from service.errors import StorageError
from service.publishing.config import PublishingConfig
from service.publishing.keys import ROOT
from service.publishing.security import access_control, link_settings

# Batches a link and priority. With Zenoh's own 2 a burst of scan, pose, odom and tf loses one now and then.
QUEUE_SIZE = 16
# Together with the page's connections fewer than the 1024 files that a process may open.
MAX_SESSIONS = 200
MAX_UNKNOWN = 400  # connections without a session yet, for 10 s each
MAX_MESSAGE_BYTES = 64 << 20
MAX_COMMAND_BYTES = 1 << 20  # of which `commands` reads less, and reports it
_SILENT_S = 600  # the kernel keeps a connection so long to itself until something is sent
_LISTENING = "0A"  # state in /proc/net/tcp


def open_session(config: PublishingConfig, max_sessions: int = MAX_SESSIONS) -> zenoh.Session:
    """A router that speaks only where configured. Routers to connect to are tried in the background for
    ever. Raises StorageError where it cannot listen.
    """
    try:
        session = zenoh.open(zenoh_config(router_settings(config, max_sessions)))
    except zenoh.ZError as error:
        text = re.sub(r" at /\S+?:\d+\.?", "", str(error))  # where in Zenoh's own source
        raise StorageError(_explain(text, config)) from error
    _keep_silent_connections_out(session, config)
    return session


def router_settings(config: PublishingConfig, max_sessions: int = MAX_SESSIONS) -> dict[str, Any]:
    """Settings of Zenoh, by path: no multicast, and no gossip but for ROS 2.

    Nodes of ROS 2 are peers; a router without gossip would let none of them find another. Raises StorageError
    where a file of the security cannot be read.
    """
    settings: dict[str, Any] = {
        "mode": "router",
        "listen/endpoints": config.listen,
        "connect/endpoints": config.connect,
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "connect/retry": {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2},
        "scouting/gossip/enabled": config.ros2.enabled,
        "scouting/delay": 0,  # nothing is scouted, so there is nothing to wait for
        "timestamping/enabled": True,
        "transport/shared_memory/enabled": config.shared_memory,
        "adminspace/enabled": _has_free_choice(config),  # read by listened_at only
        "transport/unicast/compression/enabled": True,  # of links whose other end has it on: vehicles
        "transport/unicast/max_sessions": max_sessions,
        "transport/unicast/accept_pending": MAX_UNKNOWN,
        "transport/link/rx/max_message_size": MAX_MESSAGE_BYTES,
        "low_pass_filter": [
            {
                "messages": ["query", "put"],
                "flows": ["ingress"],
                "key_exprs": [f"{ROOT}/*/cmd/**", f"{ROOT}/*/initialpose"],
                "size_limit": MAX_COMMAND_BYTES,
            }
        ],
        "transport/link/tx/queue/size/data_high": QUEUE_SIZE,
        "transport/link/tx/queue/size/data": QUEUE_SIZE,
        "transport/link/tx/queue/size/data_low": QUEUE_SIZE,
    }
    if config.secured is not None:
        domain = config.ros2.domain if config.ros2.enabled else None
        settings |= link_settings(config.secured)
        settings["access_control"] = access_control(config.secured, domain)
    return settings


def _keep_silent_connections_out(session: zenoh.Session, config: PublishingConfig) -> None:
    """Zenoh waits 10 s for what a connection sends first, for some hundred at once; by TLS it then takes in
    no other for 0.1 s each. A client speaks first: the kernel can keep a connection to itself until it has.
    """
    found = [re.search(r":(\d+)$", place) for place in listened_at(session, config)]
    ports = {int(port[1]) for port in found if port is not None}
    for listening in own_internet_sockets():
        with suppress(OSError):  # closed meanwhile
            if (
                listening.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN)
                and listening.getsockname()[1] in ports
            ):
                listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_DEFER_ACCEPT, _SILENT_S)


def listened_at(session: zenoh.Session, config: PublishingConfig) -> list[str]:
    """The endpoints as they are, with the real port where port 0 requested any free one."""
    if not _has_free_choice(config):
        return list(config.listen)
    reply = next(iter(session.get(f"@/{session.zid()}/router", timeout=2.0)))
    if reply.ok is None:
        raise StorageError(f"Zenoh does not say where it listens: {reply.err}")
    locators: list[str] = json.loads(reply.ok.payload.to_string())["locators"]
    return locators


def _has_free_choice(config: PublishingConfig) -> bool:
    return any(endpoint.endswith(":0") for endpoint in config.listen)


def _explain(error: str, config: PublishingConfig) -> str:
    found = re.search(r"(tcp|tls|udp|ws)/\S*?:(\d+)(?=[\s:\]])", error)
    where = found[0] if found else ", ".join(config.listen)
    if "os error 98" in error:
        owner = _owner_of_port(int(found[2])) if found else ""
        return (
            f"Zenoh cannot listen at {where}: the port is taken{owner}; stop that process, "
            "or change publishing.listen"
        )
    if "os error 99" in error:
        return (
            f"Zenoh cannot listen at {where}: this machine has no such address (yet); "
            "change publishing.listen; the host [::] takes every address"
        )
    if "KeyMismatch" in error and config.secured is not None and (tls := config.secured.tls) is not None:
        return (
            f"Zenoh cannot listen at {where}: {tls.key} is not the key of {tls.certificate}; bring both "
            "files from one folder of corridor security init"
        )
    return f"Zenoh does not open with publishing.listen [{', '.join(config.listen)}]: {error}"


def _owner_of_port(port: int) -> str:
    """ " by python3 (process 123)" where the kernel reports it, else ""."""
    sockets = set()
    for table in ("tcp", "tcp6"):
        path = Path("/proc/net") / table
        for line in path.read_text().splitlines()[1:] if path.exists() else []:
            fields = line.split()
            if int(fields[1].rpartition(":")[2], 16) == port and fields[3] == _LISTENING:
                sockets.add(f"socket:[{fields[9]}]")
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if any(str(descriptor.readlink()) in sockets for descriptor in (process / "fd").iterdir()):
                return f" by {(process / 'comm').read_text().strip()} (process {process.name})"
        except OSError:
            continue  # gone meanwhile, or another user's
    return " by another user's process" if sockets else ""


def own_internet_sockets() -> Iterator[socket.socket]:
    """Each TCP socket, open until the next is asked for; it is the library's own, by another descriptor."""
    for descriptor in Path("/proc/self/fd").glob("*"):
        try:
            if not str(descriptor.readlink()).startswith("socket:"):
                continue
            one = socket.socket(fileno=os.dup(int(descriptor.name)))
        except OSError:
            continue  # closed meanwhile
        with one:
            if one.family in (socket.AF_INET, socket.AF_INET6) and one.type == socket.SOCK_STREAM:
                yield one
