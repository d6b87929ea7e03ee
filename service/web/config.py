"""Settings of the operator's page."""

import re
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, Field, model_validator

from drivers.section import Section
from drivers.wires import is_host

_LISTEN = re.compile(r"(?:\[(?P<v6>[0-9A-Fa-f:.]+)\]|(?P<host>[A-Za-z0-9_.-]+)):(?P<port>\d{1,5})")
_EXAMPLE = 'write host and port as "127.0.0.1:8080" or "[::]:8080" (port 0: any free one)'
_HOST_NAME = re.compile(r"[a-z0-9]([a-z0-9-]*[a-z0-9])?(\.[a-z0-9]([a-z0-9-]*[a-z0-9])?)*")


def split_listen(listen: str) -> tuple[str, int]:
    """Host and port of "127.0.0.1:8080" or "[::1]:8080". Raises ValueError."""
    found = _LISTEN.fullmatch(listen)
    if found is None or int(found["port"]) > 65535:
        raise ValueError(_EXAMPLE)
    host = str(found["v6"] or found["host"])
    if not is_host(host):
        raise ValueError(f"{host} is neither an IP address nor a host name; {_EXAMPLE}")
    return host, int(found["port"])


def check_listen(listen: str) -> str:
    """`listen` itself; for a config model. Raises ValueError."""
    split_listen(listen)
    return listen


def _check_host_name(name: str) -> str:
    if len(name) > 253 or _HOST_NAME.fullmatch(name) is None:
        raise ValueError('write a host name in lower case without scheme and port, "vehicle.local", say')
    return name


class WebConfig(Section):
    """The operator's page. Loopback by default; what changes state needs the token."""

    enabled: bool = True
    listen: Annotated[str, AfterValidator(check_listen)] = "127.0.0.1:8080"
    # Names, besides IP addresses, localhost and this machine's own name, by which browsers may open the page.
    hosts: tuple[Annotated[str, AfterValidator(_check_host_name)], ...] = ()
    token_file: Path | None = None  # None: corridor/web.token in the state folder, see access.state_folder
    tls_certificate: Path | None = None  # PEM, the complete chain; None: plain HTTP
    tls_key: Path | None = None  # PEM
    most_browsers: int = Field(default=32, ge=1, le=1000)  # at the same time

    @property
    def tcp_addresses(self) -> list[tuple[str, int]]:
        """Host and port of the TCP listener; none where the page is off."""
        return [split_listen(self.listen)] if self.enabled else []

    @model_validator(mode="after")
    def _tls_is_complete(self) -> "WebConfig":
        if (self.tls_certificate is None) != (self.tls_key is None):
            raise ValueError("tls_certificate and tls_key go together; give both, or neither for plain HTTP")
        return self
