"""Settings of the Zenoh publisher."""

import re
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from drivers.rmw_zenoh import Distro, absolute_name
from drivers.section import Section
from drivers.wires import is_host

_EXAMPLE = 'write an endpoint as "tcp/127.0.0.1:7447" (tcp, udp, ws) or "unixsock-stream//path"'
_ENDPOINT = re.compile(r"(tcp|udp|ws)/(\[[0-9A-Fa-f:.%\w]+\]|[A-Za-z0-9_.-]+):(\d{1,5})|unixsock-stream/\S+")


def _check_endpoint(endpoint: str) -> str:
    found = _ENDPOINT.fullmatch(endpoint)
    if found is None or int(found[3] or 0) > 65535:
        raise ValueError(_EXAMPLE)
    if found[2] and not is_host(host := found[2].strip("[]")):
        raise ValueError(f"{host} is neither an IP address nor a host name; {_EXAMPLE}")
    return endpoint


Endpoint = Annotated[str, AfterValidator(_check_endpoint)]


class Ros2Config(Section):
    """Topics and services for ROS 2 nodes that run rmw_zenoh_cpp; no ROS here."""

    enabled: bool = False
    domain: int = Field(default=0, ge=0, le=232)  # ROS_DOMAIN_ID of the nodes
    distro: Distro = "jazzy"  # of the nodes: Humble's keys hold no type hashes
    namespace: Annotated[str, AfterValidator(absolute_name)] = ""  # before every name
    # The nodes' router: this service at publishing.listen, or one that publishing.connect names.
    router: Literal["own", "connect"] = "own"


class PublishingConfig(Section):
    """The Zenoh session: it is a router, so subscribers connect to it and need no other."""

    listen: tuple[Endpoint, ...] = ("tcp/127.0.0.1:7447",)  # port 0: any free one
    connect: tuple[Endpoint, ...] = ()  # further routers, a site's say; tried for ever, never waited for
    # On, it takes 16 MiB of /dev/shm a process and saves 0.1 ms on large messages.
    shared_memory: bool = False
    ros2: Ros2Config = Ros2Config()

    @model_validator(mode="after")
    def _refuse_no_router(self) -> "PublishingConfig":
        if self.ros2.enabled and self.ros2.router == "connect" and not self.connect:
            raise ValueError(
                "ros2.router is connect, and connect names no router; "
                'write connect: ["tcp/127.0.0.1:7447"] and another port in listen, or router: own'
            )
        return self
