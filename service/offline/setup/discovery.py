"""Which of our devices is at a host or a port: queried as by the live driver, until it is identified.

Nothing is sent to a host or a port that was not named, but for the serial ports of this machine. On a serial
port it first listens, then queries in an order that cannot start a robot: bytes of another protocol are
commands to it only after the command to begin, which only its own driver sends.
"""

import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from drivers.transport import SerialTransport
from drivers.wires import is_host
from service.errors import UsageError
from service.offline.doctor.probe import listen, probe
from service.offline.doctor.protocol_identification import describe, recognise_sensor
from service.sensor_kinds import SENSOR_KINDS

ASK_S = 8.0  # for the first answer of one type of device; a LUX may be silent for seconds
LISTEN_S = 0.6
LISTEN_BAUD = 115_200
PORT_NAMES = ("corridor/*", "serial/by-id/*", "ttyACM*", "ttyUSB*")  # the names that stay come first


@dataclass(frozen=True, slots=True)
class Wire:
    """A place to query: a host, with a port or with that of each type; or a device file. type "": any."""

    host: str = ""
    port: int | None = None
    device: str = ""
    type: str = ""

    def __str__(self) -> str:
        return self.device or (self.host if self.port is None else f"{self.host}:{self.port}")


@dataclass(frozen=True, slots=True)
class Found:
    """The device at one wire. type "": none of ours, `words` describe what answers instead."""

    wire: Wire
    type: str = ""
    settings: Mapping[str, Any] | None = None  # host and port, or device and what else differs
    identity: Mapping[str, str] | None = None
    words: str = ""


def parse_wire(text: str) -> Wire:
    """`192.168.0.1`, `host:2112`, `/dev/ttyUSB0`, `usb`, each also as `TYPE=...`. Raises UsageError."""
    kind, separator, where = text.rpartition("=")
    if separator and kind not in SENSOR_KINDS:
        raise UsageError(f"{text}: {kind} is no type of sensor; known: {', '.join(SENSOR_KINDS)}")
    if where.startswith(("/", ".")) or where == "usb" or "://" in where:
        return Wire(device=where, type=kind)
    host, colon, number = where.rpartition(":")
    port = None
    if colon and ":" not in host:
        if not number.isdecimal() or not 1 <= int(number) <= 65535:
            raise UsageError(f"{text}: {number} is no port; write host:2111, say")
        where, port = host, int(number)
    if not is_host(where):
        raise UsageError(f"{text!r}: name a host or a device file, such as 192.168.0.1 or /dev/ttyUSB0")
    return Wire(host=where, port=port, type=kind)


def serial_ports(dev: Path = Path("/dev")) -> list[Wire]:
    """Serial ports of this machine, each once, by its most permanent name."""
    seen: dict[Path, Wire] = {}
    for pattern in PORT_NAMES:
        for path in sorted(dev.glob(pattern)):
            seen.setdefault(path.resolve(), Wire(device=str(path)))
    return list(seen.values())


def discover(wires: Sequence[Wire], ask_s: float = ASK_S) -> list[Found]:
    """Query them all in parallel; what is at each, in their order.

    ask_s   how long each type of device has for its first answer
    """
    stop = threading.Event()
    with ThreadPoolExecutor(max_workers=max(len(wires), 1), thread_name_prefix="discovery") as workers:
        try:
            return list(workers.map(partial(_ask, ask_s=ask_s, stop=stop), wires))
        finally:
            stop.set()  # Ctrl-C: let the devices go in good order


def _ask(wire: Wire, ask_s: float, stop: threading.Event) -> Found:
    candidates: Mapping[str, Mapping[str, Any]] = {wire.type: {}} if wire.type else _queried_at(wire)
    if not wire.type and wire.device.startswith(("/", ".")):
        heard = listen(partial(SerialTransport, wire.device, LISTEN_BAUD), LISTEN_S, stop)
        recognised = {
            kind: candidates[kind] for kind in candidates if heard and recognise_sensor(heard, kind)
        }
        candidates = recognised or candidates
    words: list[str] = []
    for kind, settings in candidates.items():
        try:
            found = _ask_for(wire, kind, settings, ask_s, stop)
        except ValidationError as error:  # of these settings, or of those that the device shows
            message = error.errors()[0]["msg"].removeprefix("Value error, ")
            found = Found(wire, words=f"no {kind}: {message}")
        if found.type:
            return found
        words.append(found.words)
    return Found(wire, words="; ".join(dict.fromkeys(words)))


def _queried_at(wire: Wire) -> dict[str, Mapping[str, Any]]:
    """Types that may be there, in the order of the queries, and their settings."""
    advice = {name: kind.advice for name, kind in SENSOR_KINDS.items()}
    settings = {name: one.at_port if wire.device else one.at_host for name, one in advice.items()}
    return {name: requested for name, requested in settings.items() if requested is not None}


def _ask_for(
    wire: Wire, kind_name: str, settings: Mapping[str, Any], ask_s: float, stop: threading.Event
) -> Found:
    kind = SENSOR_KINDS[kind_name]
    where: dict[str, Any] = {"device": wire.device} if wire.device else {"host": wire.host}
    if wire.port is not None:
        where["port"] = wire.port
    config = kind.config.model_validate({"name": str(wire), **where, **settings})
    seen = probe(kind, config, ask_s, 0.0, stop, until_answered=True)
    identity = seen.reported
    if shown := kind.advice.settings_of(identity):  # of another model it may have been refused, and is known
        settings = {**settings, **shown}
        config = kind.config.model_validate({"name": str(wire), **where, **settings})
    if seen.frames or (identity and not kind.advice.doubt(config, identity)):
        port = {"port": config.port} if not wire.device and hasattr(config, "port") else {}
        return Found(wire, kind_name, {**where, **port, **settings}, seen.identity)
    if identity and seen.error is not None:  # a device of this kind that its driver refuses, with the reason
        return Found(wire, words=str(seen.error))
    if seen.first_bytes:
        return Found(wire, words=f"no {kind_name}, but {describe(bytes(seen.first_bytes))}")
    return Found(wire, words=str(seen.error) if seen.error is not None else f"no {kind_name} answers")
