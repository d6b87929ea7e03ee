"""Settings of the Zenoh publisher."""

import ipaddress
import re
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from drivers.rmw_zenoh import Distro, absolute_name
from drivers.section import Section
from drivers.wires import is_host
from service.publishing.security import Security, SecurityConfig

_EXAMPLE = 'write an endpoint as "tcp/127.0.0.1:7447" (tcp, tls, udp, ws) or "unixsock-stream//path"'
_ENDPOINT = re.compile(
    r"(tcp|tls|udp|ws)/(\[[0-9A-Fa-f:.%\w]+\]|[A-Za-z0-9_.-]+):(\d{1,5})|unixsock-stream/\S+"
)


def _check_endpoint(endpoint: str) -> str:
    found = _ENDPOINT.fullmatch(endpoint)
    if found is None or int(found[3] or 0) > 65535:
        raise ValueError(_EXAMPLE)
    if found[2] and not is_host(host := found[2].strip("[]")):
        raise ValueError(f"{host} is neither an IP address nor a host name; {_EXAMPLE}")
    return endpoint


def _refuse_tls(endpoint: str) -> str:
    if endpoint.startswith("tls/"):
        raise ValueError(
            "a sensor's router is reached without TLS; write that of this machine, tcp/127.0.0.1:7447"
        )
    return endpoint


Endpoint = Annotated[str, AfterValidator(_check_endpoint)]
PlainEndpoint = Annotated[Endpoint, AfterValidator(_refuse_tls)]


def host_of(endpoint: str) -> str:
    """Host of an Endpoint, without brackets; "" for a socket file."""
    found = _ENDPOINT.fullmatch(endpoint)
    return (found[2] or "").strip("[]") if found is not None else ""


def tcp_address(endpoint: str) -> tuple[str, int] | None:
    """Host and port of an Endpoint over TCP; None for others."""
    found = _ENDPOINT.fullmatch(endpoint)
    if found is None or found[1] in (None, "udp"):
        return None
    return host_of(endpoint), int(found[3])


def is_local(endpoint: str) -> bool:
    """Whether it is an address of this machine alone."""
    host = host_of(endpoint)
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host in ("", "localhost")


class Ros2Config(Section):
    """Topics and services for ROS 2 nodes that run rmw_zenoh_cpp; no ROS here."""

    enabled: bool = False
    domain: int = Field(default=0, ge=0, le=232)  # ROS_DOMAIN_ID of the nodes
    distro: Distro = "jazzy"  # of the nodes: Humble's keys hold no type hashes
    namespace: Annotated[str, AfterValidator(absolute_name)] = ""  # before every name
    # The nodes' router: this service at publishing.listen, or one that publishing.connect names.
    router: Literal["own", "connect"] = "own"


class FleetConfig(Section):
    """Data for the routers of a site, over a session of its own. Without `connect`: none."""

    connect: tuple[Endpoint, ...] = ()  # one of them is connected to, the others stand by
    pose_hz: float = Field(default=5.0, gt=0.0, le=100.0)  # at most
    health_hz: float = Field(default=1.0, gt=0.0, le=1.0)  # at most
    tiles: bool = True  # those of the map that change
    tile_period_s: float = Field(default=2.0, ge=0.2, le=3600.0)  # at least, from one sending to the next
    commands: bool = True  # of clients that the router allows to command


class PublishingConfig(Section):
    """The Zenoh session: it is a router, so subscribers connect to it and need no other."""

    listen: tuple[Endpoint, ...] = ("tcp/127.0.0.1:7447",)  # port 0: any free one
    connect: tuple[Endpoint, ...] = ()  # further routers, as a site's; tried for ever, never waited for
    # On, it takes 16 MiB of /dev/shm a process and saves 0.1 ms on large messages.
    shared_memory: bool = False
    ros2: Ros2Config = Ros2Config()
    security: Security = SecurityConfig()
    fleet: FleetConfig = FleetConfig()

    @property
    def secured(self) -> SecurityConfig | None:
        """The settings of security where there is any."""
        return self.security if self.security != "none" and self.security.is_on else None

    @property
    def tcp_addresses(self) -> list[tuple[str, int]]:
        """Host and port of each TCP listener; one at [::] is at all addresses of IPv4 as well."""
        named = [address for endpoint in self.listen if (address := tcp_address(endpoint)) is not None]
        return named + [("0.0.0.0", port) for host, port in named if host == "::"]

    @model_validator(mode="after")
    def _refuse_open_endpoints(self) -> "PublishingConfig":
        has_tls = self.secured is not None and self.secured.tls is not None
        for endpoint in (*self.listen, *self.connect, *self.fleet.connect):
            if endpoint.startswith("tls/"):
                if not has_tls:
                    raise ValueError(
                        f"{endpoint} needs security: {{tls: {{ca: ..., certificate: ..., key: ...}}}}; "
                        "`corridor security init` makes the files"
                    )
            elif not is_local(endpoint) and self.security != "none":
                raise ValueError(
                    f"{endpoint} is open to the network without security; write tls/ and "
                    "security: {tls: ...}, for which `corridor security init` makes the files, "
                    "or security: none where each machine on the network may command the vehicle"
                )
        users = self.secured.users if self.secured is not None else None
        if users is not None and users.name is None and (self.connect or self.fleet.connect):
            raise ValueError(
                "connect names a router, and security.users no name; write the user by which this service "
                "connects there, name: veh1, say"
            )
        return self

    @model_validator(mode="after")
    def _refuse_no_router(self) -> "PublishingConfig":
        if self.ros2.enabled and self.ros2.router == "connect" and not self.connect:
            raise ValueError(
                "ros2.router is connect, and connect names no router; "
                'write connect: ["tcp/127.0.0.1:7447"] and another port in listen, or router: own'
            )
        return self
