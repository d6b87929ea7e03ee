"""Where Zenoh is to listen: free, taken by the service itself, or by somebody else."""

import errno
import re
import socket

from service.config import ServiceConfig
from service.offline.doctor.findings import Finding, fault, note, ok
from service.offline.doctor.machine import Machine
from service.offline.doctor.processes import listeners, running_services
from service.offline.doctor.running import RunningService


def look_at_zenoh(machine: Machine, config: ServiceConfig) -> tuple[list[Finding], RunningService | None]:
    """A finding for each place to listen at, and the running service that holds one."""
    found, service = [], None
    for endpoint in config.sinks["publishing"].listen:
        finding, holder = _endpoint(machine, endpoint)
        found.append(finding)
        service = service or holder
    return found, service


def _endpoint(machine: Machine, endpoint: str) -> tuple[Finding, RunningService | None]:
    parts = re.fullmatch(r"(tcp|udp|ws)/\[?([^\]]+?)\]?:(\d+)", endpoint)
    if parts is None:
        return ok("zenoh", f"{endpoint} is not tried"), None
    host, port = parts[2], int(parts[3])
    kind = socket.SOCK_DGRAM if parts[1] == "udp" else socket.SOCK_STREAM
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=kind, flags=socket.AI_PASSIVE)[0]
        with socket.socket(family, kind) as trial:
            trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            trial.bind(address)
            if kind == socket.SOCK_STREAM:
                trial.listen(1)
    except OSError as error:
        return _taken(machine, endpoint, port, error)
    return ok("zenoh", f"{endpoint} is free" if port else f"{endpoint} takes any free port"), None


def _taken(
    machine: Machine, endpoint: str, port: int, error: OSError
) -> tuple[Finding, RunningService | None]:
    if error.errno != errno.EADDRINUSE:
        words = "this machine has no such address" if error.errno == errno.EADDRNOTAVAIL else str(error)
        remedy = "change publishing.listen; tcp/[::]:7447 takes every address"
        return fault("zenoh", f"cannot listen at {endpoint}: {words}", "a place to listen at", remedy), None
    owners, _ = listeners(machine, port)
    services = [owner for owner in owners if owner.is_service]
    if not owners:
        services = running_services(machine)  # another user's: the kernel shows its name, not its sockets
    if services:
        words = (
            f"{services[0]} is the running service and listens at {endpoint}; its devices are in use by it"
        )
        remedy = "the lines on devices below are its health; stop it to examine the devices themselves"
        return note("zenoh", words, remedy), RunningService(services[0], endpoint)
    held = " and ".join(map(str, owners)) or "another user's process, which only root sees"
    return fault(
        "zenoh",
        f"{endpoint} is taken by {held}",
        "a free port",
        "stop that program, or change publishing.listen",
    ), None
