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

THIS_MACHINE, OWN_ADDRESSES = "127.0.0.1", frozenset(("127.0.0.1", "::1", "0.0.0.0", "::"))
NAME_TIMEOUT_S = 2.0  # for the addresses of a name: a dead name server is queried for 10 s and more


class TcpWire(NamedTuple):
    host: str
    port: int


class PortWire(NamedTuple):
    device: str


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


def wire_of(config: Any) -> TcpWire | PortWire | None:
    """Wire by the settings that all types share: host and port, or device. None: another kind of wire."""
    host, device = getattr(config, "host", None), getattr(config, "device", None)
    if host is not None:
        return TcpWire(host, config.port)
    if device is None:
        return None
    scheme, separator, rest = device.partition("://")
    if not separator:
        return PortWire(device) if device.startswith(("/", ".")) or Path(device).exists() else None
    name, _, port = rest.partition("?")[0].rpartition(":")
    if scheme.lower() not in ("socket", "rfc2217") or not port.isdigit():
        return None
    return TcpWire(name.removeprefix("[").removesuffix("]"), int(port))


def shared_devices(
    sensors: Mapping[str, Any], real_path: Callable[[str], str] = os.path.realpath
) -> list[SharedDevice]:
    """Sensors whose device files are links to one file, or whose hosts have one address at the same port."""
    wires = {name: wire for name, sensor in sensors.items() if (wire := wire_of(sensor)) is not None}
    files = {name: real_path(wire.device) for name, wire in wires.items() if isinstance(wire, PortWire)}
    calls = {name: wire for name, wire in wires.items() if isinstance(wire, TcpWire)}
    return [*_linked_files(files), *_hosts_with_one_address(sensors, calls)]


def _linked_files(files: Mapping[str, str]) -> Iterator[SharedDevice]:
    owners: dict[str, str] = {}
    for name, file in files.items():
        owner = owners.setdefault(file, name)
        if owner != name:
            yield SharedDevice(name, "device", owner, file)


def _hosts_with_one_address(
    sensors: Mapping[str, Any], wires: Mapping[str, TcpWire]
) -> Iterator[SharedDevice]:
    at_port: dict[int, list[str]] = {}
    for name, wire in wires.items():
        at_port.setdefault(wire.port, []).append(name)
    for port, names in at_port.items():
        owners: dict[str, str] = {}
        for name in names if len(names) > 1 else ():
            shared = ""
            for address in sorted(known_addresses(wires[name].host)):
                if owners.setdefault(address, name) != name:
                    shared = address
            if shared:
                key = "device" if getattr(sensors[name], "host", None) is None else "host"
                yield SharedDevice(name, key, owners[shared], f"{shared}:{port}")


def known_addresses(host: str) -> frozenset[str]:
    """Addresses of a host, as this machine resolves it; the host itself after NAME_TIMEOUT_S without any.

    Those by which this machine reaches itself are one: a device behind them mostly listens at all.
    """
    answer: Future[frozenset[str]] = Future()

    def ask() -> None:
        try:
            found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
        except (OSError, UnicodeError):
            found = []
        spelt = (one_spelling(str(address[0])) for *_, address in found)
        answer.set_result(frozenset(THIS_MACHINE if one in OWN_ADDRESSES else one for one in spelt))

    threading.Thread(target=ask, name=f"addresses of {host}", daemon=True).start()
    try:
        return answer.result(NAME_TIMEOUT_S) or frozenset((host,))
    except TooLateError:
        return frozenset((host,))
