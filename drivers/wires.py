"""Types of a config for the host of a device and the device file of a port."""

import ipaddress
import re
from typing import Annotated

from pydantic import AfterValidator

_LABEL = r"[A-Za-z0-9_]([A-Za-z0-9_-]*[A-Za-z0-9_])?"
_HOST_NAME = re.compile(rf"(?!.*[^.]{{64}}){_LABEL}(\.{_LABEL})*\.?")  # RFC 1035: 63 characters a label
_LOOKS_LIKE_IPV4 = re.compile(r"[0-9.]+")
MAX_HOST_CHARS = 253  # RFC 1035, section 2.3.4


def is_host(host: str) -> bool:
    """Whether it is an IP address, also with a zone as in fe80::1%eth0, or can be a host's name."""
    try:
        ipaddress.ip_address(host)
    except ValueError:
        is_name = len(host) <= MAX_HOST_CHARS and _HOST_NAME.fullmatch(host) is not None
        return is_name and not _LOOKS_LIKE_IPV4.fullmatch(host)
    return True


def _check_host(host: str) -> str:
    if not is_host(host):
        raise ValueError(
            "neither an IP address nor a host name; write 192.168.0.1, say, without port, space or URL"
        )
    return host


def one_spelling(host: str) -> str:
    """Canonical spelling of a host's name or address."""
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return host.rstrip(".").lower()
    mapped = address.ipv4_mapped if isinstance(address, ipaddress.IPv6Address) else None
    return str(mapped or address)


def _check_device(device: str) -> str:
    if not device.strip() or device != device.strip():
        raise ValueError("a path without spaces at its ends; write /dev/ttyUSB0, say")
    if "\0" in device:
        raise ValueError("holds a NUL; write /dev/ttyUSB0, say")
    if device.startswith("~"):
        raise ValueError("~ is not expanded here; write the whole path, such as /dev/ttyUSB0")
    return device


Host = Annotated[str, AfterValidator(_check_host)]  # IPv4, IPv6 or a name
DeviceFile = Annotated[str, AfterValidator(_check_device)]  # a path, or a URL of pyserial
