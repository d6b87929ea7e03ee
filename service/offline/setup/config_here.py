"""Faults of a valid config that only the machine shows: one device under two names, a map that is not there.

The service meets them at its start or later; `corridor check` and `corridor doctor` look before.
"""

import os
import socket
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from concurrent.futures import TimeoutError as TooLateError
from pathlib import Path
from typing import Any, NamedTuple

from drivers.wires import one_spelling
from service.config import ServiceConfig
from service.errors import CorridorError
from service.located_yaml import Fault, load
from service.located_yaml import Path as KeyPath
from service.mapstore.begin_in import stored_for

NAME_TIMEOUT_S = 2.0  # for the addresses of a name: a dead name server is queried for 10 s and more


class SharedDevice(NamedTuple):
    """Two sensors of a config that are one device."""

    sensor: str
    key: str  # of the sensor, that names the device
    other: str
    device: str  # what both names lead to


def faults_here(config: ServiceConfig, file: str) -> list[str]:
    """Faults as in ConfigError; `file` is the config's name in them."""
    document = load(config.text)
    found: list[tuple[KeyPath, str]] = [
        (
            ("sensors", shared.sensor, shared.key),
            f"this is {shared.device}, as is that of {shared.other}; two sensors cannot share a device: "
            "give each its own, or take one out",
        )
        for shared in shared_devices(config.sensors)
    ]
    if config.begin_in is not None:
        try:
            stored_for(config.begin_in, config.mapping)
        except CorridorError as error:
            advice = "write the folder of a stored map that a session can begin in, or take this line out"
            why = "; ".join(line.strip() for line in str(error).splitlines())
            found.append((("map", "load"), f"{why}; {advice}"))
    faults = [Fault(document.position(path), path, message) for path, message in found]
    return [fault.text(file) for fault in sorted(faults, key=lambda fault: fault.position.line)]


def shared_devices(
    sensors: Mapping[str, Any], real_path: Callable[[str], str] = os.path.realpath
) -> list[SharedDevice]:
    """Sensors whose device files are links to one file, or whose hosts have one address at the same port."""
    return [*_linked_files(sensors, real_path), *_hosts_with_one_address(sensors)]


def _linked_files(sensors: Mapping[str, Any], real_path: Callable[[str], str]) -> Iterator[SharedDevice]:
    owners: dict[str, str] = {}
    for name, sensor in sensors.items():
        device = getattr(sensor, "device", None)
        if device is None or not Path(device).is_absolute():  # a URL, or usb
            continue
        owner = owners.setdefault(real_path(device), name)
        if owner != name:
            yield SharedDevice(name, "device", owner, real_path(device))


def _hosts_with_one_address(sensors: Mapping[str, Any]) -> Iterator[SharedDevice]:
    at_port: dict[int, list[str]] = {}
    for name, sensor in sensors.items():
        if getattr(sensor, "host", None) is not None:
            at_port.setdefault(sensor.port, []).append(name)
    for port, names in at_port.items():
        owners: dict[str, str] = {}
        for name in names if len(names) > 1 else ():
            shared = ""
            for address in sorted(known_addresses(sensors[name].host)):
                if owners.setdefault(address, name) != name:
                    shared = address
            if shared:
                yield SharedDevice(name, "host", owners[shared], f"{shared}:{port}")


def known_addresses(host: str) -> frozenset[str]:
    """Addresses of a host, as this machine resolves it; the host itself after NAME_TIMEOUT_S without any."""
    answer: Future[frozenset[str]] = Future()

    def ask() -> None:
        try:
            found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
        except (OSError, UnicodeError):
            found = []
        answer.set_result(frozenset(one_spelling(str(address[0])) for *_, address in found))

    threading.Thread(target=ask, name=f"addresses of {host}", daemon=True).start()
    try:
        return answer.result(NAME_TIMEOUT_S) or frozenset((host,))
    except TooLateError:
        return frozenset((host,))
