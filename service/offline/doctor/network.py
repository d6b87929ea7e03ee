"""A device on the network: the route to it before connecting, and why a connection failed."""

import errno
import ipaddress
import socket
from dataclasses import dataclass

from service.errors import words_of
from service.offline.doctor.findings import Finding, fault
from service.offline.doctor.machine import Machine

_UP, _GATEWAY = 0x1, 0x2  # flags in /proc/net/route
_ARP_COMPLETE = 0x2


@dataclass(frozen=True, slots=True)
class Route:
    """A route of this machine; `gateway` is "" within the interface's own net."""

    interface: str
    network: ipaddress.IPv4Network
    gateway: str


def resolve(who: str, host: str, port: int) -> tuple[str, Finding | None]:
    """The address of a host's name, or a fault."""
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except (socket.gaierror, UnicodeError) as error:
        return "", fault(
            who,
            f"the name {host} has no address: {words_of(error)}",
            "an address, or a name this machine knows",
            "write the device's address as `host`, or the name into /etc/hosts",
        )
    return str(family[0][4][0]), None


def routes(machine: Machine) -> list[Route]:
    """The kernel's table; IPv4 only."""
    found = []
    for line in machine.text("/proc/net/route").splitlines()[1:]:
        interface, network, gateway, flags, *_, mask = line.split()[:8]
        if int(flags, 16) & _UP:
            net = ipaddress.IPv4Network((_number(network), _number(mask).bit_count()), strict=False)
            by = str(ipaddress.IPv4Address(_number(gateway))) if int(flags, 16) & _GATEWAY else ""
            found.append(Route(interface, net, by))
    return found


def route_to(machine: Machine, address: str) -> Route | None:
    """Route by the kernel's table; None where no line fits. IPv4 only: other addresses count as direct."""
    target = ipaddress.ip_address(address)
    if target.is_loopback or target.version != 4:
        return Route("lo", ipaddress.IPv4Network("127.0.0.0/8"), "")
    fitting = [route for route in routes(machine) if target in route.network]
    return max(fitting, key=lambda route: route.network.prefixlen, default=None)


def look_at_route(machine: Machine, who: str, address: str) -> Finding | None:
    """A fault where this machine has no route to the address, or one without a cable."""
    if not machine.text("/proc/net/route"):
        return None  # no table: the connection itself will show it
    route = route_to(machine, address)
    if route is None:
        return _no_route(machine, who, address)
    if machine.text(f"/sys/class/net/{route.interface}/carrier") == "0":
        return fault(
            who,
            f"the route to {address} is {route.interface}, and nothing is plugged in there (no carrier)",
            "a link",
            "look at the cable, the switch and the device's supply",
        )
    return None


def call_failed(machine: Machine, who: str, address: str, port: int, error: Exception) -> Finding:
    """Why a TCP connection did not come about; `error` is what the transport raised."""
    number = errno_of(error)
    where = f"{address}:{port}"
    if number == errno.ECONNREFUSED:
        return fault(
            who,
            f"{address} is there, but nothing listens at port {port} (connection refused)",
            f"the device at port {port}",
            "just switched on: wait; else is `port` right, is `host` really this device?",
        )
    if number in (errno.ENETUNREACH, errno.EADDRNOTAVAIL):
        return _no_route(machine, who, address)
    if number == errno.ECONNRESET:
        return fault(
            who,
            f"{where} accepts and hangs up at once",
            "the device to talk to us",
            "it serves another host or program: end that one; after a broken connection wait a minute",
        )
    if number in (errno.EHOSTUNREACH, errno.ETIMEDOUT) or isinstance(error.__cause__, TimeoutError):
        return _no_host_there(machine, who, address, port)
    return fault(
        who,
        f"cannot connect to {where}: {error.__cause__ or error}",
        "a connection",
        "look at host, port and the cable",
    )


def _no_host_there(machine: Machine, who: str, address: str, port: int) -> Finding:
    route = route_to(machine, address)
    if route is not None and route.gateway:
        return fault(
            who,
            f"no answer from {address}; the route leads over {route.interface} and the gateway "
            f"{route.gateway}, for {_own_nets(machine)}",
            "an interface in the device's own net",
            _new_address(address),
        )
    on = f" on {route.interface}" if route else ""
    if _is_unanswered(machine, address):
        measured = f"no machine has the address {address}{on} (no answer to ARP)"
    else:
        measured = f"no answer from {address} at port {port}{on}"
    return fault(
        who,
        measured,
        "the device to answer within 3 s",
        "is it switched on, is the cable in, has it another address? a firewall looks like this too",
    )


def errno_of(error: Exception) -> int | None:
    """The system's number behind an error of a transport, None where there is none."""
    cause = error.__cause__ if isinstance(error.__cause__, OSError) else error
    return cause.errno if isinstance(cause, OSError) else None


def _is_unanswered(machine: Machine, address: str) -> bool:
    """Whether the kernel has requested it by ARP, without an answer."""
    entries = [line.split() for line in machine.text("/proc/net/arp").splitlines()[1:]]
    return any(entry[0] == address and not int(entry[2], 16) & _ARP_COMPLETE for entry in entries)


def _no_route(machine: Machine, who: str, address: str) -> Finding:
    return fault(
        who,
        f"this machine has no route to {address}; {_own_nets(machine)}",
        "an interface with an address in the device's net",
        _new_address(address),
    )


def _own_nets(machine: Machine) -> str:
    own = [route for route in routes(machine) if not route.gateway and int(route.network.network_address)]
    nets = ", ".join(f"{route.network} on {route.interface}" for route in own)
    return f"its own nets are {nets}" if nets else "it is in no net of its own"


def _number(little_endian_hex: str) -> int:
    return int.from_bytes(bytes.fromhex(little_endian_hex), "little")


def _new_address(address: str) -> str:
    """The command that gives this machine a free-looking address in the same /24."""
    head, _, last = address.rpartition(".")
    neighbour = f"{head}.{'200' if last != '200' else '201'}" if head else address
    return f"sudo ip addr add {neighbour}/24 dev <interface at the device's cable>"
