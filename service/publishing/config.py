"""Settings of the Zenoh publisher."""

import re
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict

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


class PublishingConfig(BaseModel):
    """The Zenoh session: it is a router, so subscribers connect to it and need no other."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    listen: tuple[Endpoint, ...] = ("tcp/127.0.0.1:7447",)  # port 0: any free one
    connect: tuple[Endpoint, ...] = ()  # further routers, a site's say; tried for ever, never waited for
    # On, it takes 16 MiB of /dev/shm a process and saves 0.1 ms on large messages.
    shared_memory: bool = False
