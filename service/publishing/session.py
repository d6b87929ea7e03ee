"""Opens the Zenoh session; a failure gets a reason."""

import json
import re
from pathlib import Path

import zenoh

from drivers.zenoh_config import zenoh_config
from service.errors import StorageError
from service.publishing.config import PublishingConfig

# Batches a link and priority. With Zenoh's own 2 a burst of scan, pose, odom and tf loses one now and then.
QUEUE_SIZE = 16
_LISTENING = "0A"  # state in /proc/net/tcp


def open_session(config: PublishingConfig) -> zenoh.Session:
    """A router that speaks only where the config says: no multicast, and no gossip but for ROS 2.

    Nodes of ROS 2 are peers; a router without gossip would let none of them find another.
    Routers to connect to are tried in the background for ever. Raises StorageError where it cannot listen.
    """
    settings = {
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
        "transport/link/tx/queue/size/data_high": QUEUE_SIZE,
        "transport/link/tx/queue/size/data": QUEUE_SIZE,
        "transport/link/tx/queue/size/data_low": QUEUE_SIZE,
    }
    try:
        return zenoh.open(zenoh_config(settings))
    except zenoh.ZError as error:
        text = re.sub(r" at /\S+?:\d+\.?", "", str(error))  # where in Zenoh's own source
        raise StorageError(_explain(text, config)) from error


def listened_at(session: zenoh.Session, config: PublishingConfig) -> list[str]:
    """The endpoints as they are, with the real port where port 0 asked for any free one."""
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
    found = re.search(r"(tcp|udp|ws)/\S*?:(\d+)(?=[\s:\]])", error)
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
            "change publishing.listen, tcp/[::]:7447 takes every address"
        )
    return f"Zenoh does not open with publishing.listen [{', '.join(config.listen)}]: {error}"


def _owner_of_port(port: int) -> str:
    """ " by python3 (process 123)" where the kernel tells us, else ""."""
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
