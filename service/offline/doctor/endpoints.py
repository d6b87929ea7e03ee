"""The endpoints of Zenoh, page and Foxglove: free, in use by the running service, or taken."""

import errno
import re
import socket
from dataclasses import dataclass

from service.config import ServiceConfig
from service.offline.doctor.findings import Finding, fault, note, ok
from service.offline.doctor.machine import Machine
from service.offline.doctor.processes import Process, listeners, processes
from service.offline.doctor.running import RunningService
from service.web.config import split_listen

MIN_FREE_PORT = 1024  # below, binding takes a right


@dataclass(frozen=True, slots=True)
class _Door:
    """A place to listen at: `key` of the config, for the output `who`."""

    who: str
    key: str
    text: str  # as configured
    host: str
    port: int
    protocol: str = "tcp"

    @property
    def kind(self) -> socket.SocketKind:
        return socket.SOCK_STREAM if self.protocol == "tcp" else socket.SOCK_DGRAM


def look_at_zenoh(machine: Machine, config: ServiceConfig) -> tuple[list[Finding], RunningService | None]:
    """A finding for each place to listen at, and the running service that holds one."""
    found, service = [], None
    for endpoint in config.sinks["publishing"].listen:
        parts = re.fullmatch(r"(tcp|tls|udp|ws)/\[?([^\]]+?)\]?:(\d+)", endpoint)
        if parts is None:
            found.append(ok("zenoh", f"{endpoint} is not tried"))
            continue
        protocol = "udp" if parts[1] == "udp" else "tcp"
        door = _Door("zenoh", "publishing.listen", endpoint, parts[2], int(parts[3]), protocol)
        error = _tried(machine, door)
        holder = _service_at(machine, door) if _is_taken(error) else None
        if holder is not None:
            words = f"{holder} is the running service and listens at {endpoint}; its devices are in use by it"
            remedy = "the lines on devices below are its health; stop it to examine the devices themselves"
            found.append(note("zenoh", words, remedy))
            service = service or RunningService(holder, endpoint)
        else:
            found.append(_finding(machine, door, error))
    return found, service


def look_at_pages(machine: Machine, config: ServiceConfig, running: RunningService | None) -> list[Finding]:
    """A finding for the page and one for Foxglove, where the config has them; `running` may hold them."""
    found = []
    for who in ("web", "foxglove"):
        settings = config.sinks[who]
        if not settings.enabled:
            continue
        door = _Door(who, f"{who}.listen", settings.listen, *split_listen(settings.listen))
        error = _tried(machine, door)
        if running is not None and _is_taken(error) and _service_at(machine, door) == running.process:
            found.append(ok(who, f"{door.text} is served by the running service, {running.process}"))
        else:
            found.append(_finding(machine, door, error))
    return found


def _tried(machine: Machine, door: _Door) -> OSError | None:
    """Why the address cannot be bound; None: it can."""
    try:
        family, _, _, _, address = socket.getaddrinfo(
            door.host, door.port, type=door.kind, flags=socket.AI_PASSIVE
        )[0]
        with socket.socket(family, door.kind) as trial:
            if door.kind == socket.SOCK_STREAM:
                trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            machine.bind(trial, address)
            if door.kind == socket.SOCK_STREAM:
                trial.listen(1)
    except OSError as error:
        return error
    return None


def _is_taken(error: OSError | None) -> bool:
    return error is not None and error.errno == errno.EADDRINUSE


def _service_at(machine: Machine, door: _Door) -> Process | None:
    """The `corridor run` or `corridor demo` that holds a taken endpoint, if one does."""
    # Another user's: the kernel shows its name, not its sockets.
    owners = listeners(machine, door.port, door.protocol) or processes(machine)
    return next((owner for owner in owners if owner.is_service), None)


def _finding(machine: Machine, door: _Door, error: OSError | None) -> Finding:
    if error is None:
        return ok(door.who, f"{door.text} is free" if door.port else f"{door.text} takes any free port")
    if _is_taken(error):
        owners = listeners(machine, door.port, door.protocol)
        owner_names = " and ".join(map(str, owners)) or "another user's process, which only root sees"
        remedy = f"stop that program, or change {door.key}"
        return fault(door.who, f"{door.text} is taken by {owner_names}", "a free port", remedy)
    words, remedy = str(error), f"change {door.key}"
    if error.errno == errno.EADDRNOTAVAIL:
        words, remedy = "this machine has no such address", f"{remedy}; host [::] takes every address"
    elif error.errno == errno.EACCES:
        words = f"{machine.user} may not bind port {door.port}"
        remedy += f" to a port from {MIN_FREE_PORT} on, or give the service CAP_NET_BIND_SERVICE"
    return fault(door.who, f"cannot listen at {door.text}: {words}", "a place to listen at", remedy)
