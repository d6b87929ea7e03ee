"""Examines one sensor: its wire, then its own session on it. Independent of the types of sensors."""

import errno
import os
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from drivers.sensor_kind import SensorKind
from drivers.transport import SerialTransport
from service.offline.doctor import verdict
from service.offline.doctor.findings import Finding, fault
from service.offline.doctor.machine import Machine
from service.offline.doctor.network import call_failed, errno_of, look_at_route, resolve
from service.offline.doctor.probe import Probe, listen, probe
from service.offline.doctor.protocol_identification import recognise_sensor
from service.offline.doctor.serial_ports import busy_finding, look_at_port
from service.offline.setup.config_here import PortWire, TcpWire, shared_devices, wire_of
from service.sensor_kinds import SENSOR_KINDS

OTHER_SETTINGS_S = 4.0
LISTEN_S = 0.6  # a stream of 10 messages a second shows itself in it
MEASURE_S = 3.0


@dataclass(frozen=True, slots=True)
class Patience:
    """How long a device is examined. `start_up_s` None: as long as its type may take."""

    measure_s: float = MEASURE_S
    start_up_s: float | None = None
    other_settings_s: float = OTHER_SETTINGS_S
    listen_s: float = LISTEN_S


def look_at_shared(machine: Machine, sensors: Mapping[str, Any]) -> list[Finding]:
    """A fault for each sensor that is the device of another one."""
    return [
        fault(
            shared.sensor,
            f"its {shared.key} is {shared.device}, as is that of {shared.other}",
            "a device for each sensor",
            f"give {shared.sensor} or {shared.other} another {shared.key}, or take one of them out",
        )
        for shared in shared_devices(sensors, lambda device: os.path.realpath(machine.path(device)))
    ]


def examine_sensor(machine: Machine, config: Any, patience: Patience, stop: threading.Event) -> list[Finding]:
    """All findings on one sensor, a cause before its consequences."""
    kind, who, wire = SENSOR_KINDS[config.type], config.name, wire_of(config)
    found: list[Finding] = []
    if isinstance(wire, PortWire):
        port = look_at_port(machine, who, wire.device)
        found += port.findings
        if not port.can_be_opened:
            return found
    if isinstance(wire, TcpWire):
        address, unknown = resolve(who, wire.host, wire.port)
        blocking = unknown or look_at_route(machine, who, address)
        if blocking is not None:
            return [blocking]
    start_up_s = kind.advice.start_up_s if patience.start_up_s is None else patience.start_up_s
    seen = probe(kind, config, start_up_s, patience.measure_s, stop)
    if not seen.opened:
        return [*found, _not_opened(machine, who, wire, seen)]
    return [*found, *_judge(kind, config, wire, seen, patience, stop)]


def _not_opened(machine: Machine, who: str, wire: TcpWire | PortWire | None, seen: Probe) -> Finding:
    error = seen.error
    assert error is not None
    if isinstance(wire, TcpWire):
        address, unknown = resolve(who, wire.host, wire.port)
        return unknown or call_failed(machine, who, address, wire.port, error)
    if isinstance(wire, PortWire) and errno_of(error) in (errno.EBUSY, errno.EAGAIN):
        return busy_finding(who, wire.device, [])
    measured, _, remedy = str(error).partition("; ")
    return fault(who, measured, "an open wire", remedy or "see the device's page in docs/devices")


def _judge(
    kind: SensorKind,
    config: Any,
    wire: TcpWire | PortWire | None,
    seen: Probe,
    patience: Patience,
    stop: threading.Event,
) -> list[Finding]:
    if seen.frames:
        return verdict.streaming(kind, config, seen)
    heard = bytes(seen.first_bytes)
    if heard and seen.reported and seen.error is None:
        return [verdict.slow(config, seen)]
    if seen.reported or kind.advice.recognise(heard):
        return [verdict.refused(config, seen)]
    if isinstance(wire, PortWire):
        for baud in _other_bauds(kind, config):
            opening = partial(SerialTransport, wire.device, baud)
            if words := recognise_sensor(listen(opening, patience.listen_s, stop), config.type):
                return [verdict.wrong_baud(config, seen, baud, words)]
    if not heard:
        for other in kind.advice.other_settings(config):
            answer = probe(kind, other.config, patience.other_settings_s, 0.0, stop, until_answered=True)
            if answer.frames or answer.reported:
                return [verdict.other_settings(config, seen, other.words, answer)]
        return [verdict.silent(kind, config, seen)]
    return [verdict.wrong_device(config, seen, isinstance(wire, PortWire))]


def _other_bauds(kind: SensorKind, config: Any) -> list[int]:
    configured = getattr(config, "baud", None)
    return [baud for baud in kind.advice.bauds if baud != configured] if isinstance(configured, int) else []
