"""The service runs already: then its devices are its own, and it is queried for their state instead."""

import queue
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import zenoh

from drivers.zenoh_callback import daemon_callback
from drivers.zenoh_config import zenoh_config
from service.encoding import Status, decode_diagnostics
from service.errors import InputError, StorageError
from service.offline.doctor.findings import Finding, Severity, fault, note
from service.offline.doctor.processes import Process
from service.publishing.keys import vehicle_key
from service.publishing.security import SecurityConfig, link_settings

HEALTH_WAIT_S = 3.0  # it comes each second
_SEVERITIES: Mapping[int, Severity] = {0: "ok", 1: "note"}
SENSOR_PREFIX = "sensor/"


@dataclass(frozen=True, slots=True)
class RunningService:
    process: Process
    endpoint: str  # of Zenoh, where it listens


def ask_health(
    running: RunningService,
    vehicle: str,
    security: SecurityConfig | None = None,
    wait_s: float = HEALTH_WAIT_S,
) -> list[Status]:
    """The newest health message of this vehicle's service; empty where none comes in time.

    security   by whose files it connects
    """
    endpoint = re.sub(r"/(0\.0\.0\.0|\[::\]):", "/localhost:", running.endpoint)  # as a certificate has it
    settings: dict[str, Any] = {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": round(wait_s * 1e3),
    }
    heard: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
    try:
        if security is not None:
            settings |= link_settings(security)
        with zenoh.open(zenoh_config(settings)) as session:
            session.declare_subscriber(vehicle_key(vehicle, "health"), daemon_callback(heard.put, "health"))
            return decode_diagnostics(heard.get(timeout=wait_s).payload.to_bytes())
    except (zenoh.ZError, queue.Empty, InputError, StorageError):
        return []


def from_health(
    running: RunningService, vehicle: str, sensors: Sequence[str], statuses: Sequence[Status]
) -> list[Finding]:
    """A finding for each sensor of the config and each part of the service."""
    if not statuses:
        return [
            fault(
                "service",
                f"{running.process} listens at {running.endpoint}, but no health of vehicle {vehicle} comes",
                "a health message each second",
                "is that another vehicle's service? if not: systemctl status, journalctl -u 'corridor@*'",
            )
        ]
    found = [_from_status(status) for status in statuses]
    facts = {status.name.removeprefix(SENSOR_PREFIX) for status in statuses}
    found += [
        note(
            name,
            f"the running service ({running.process}) knows no such sensor",
            "it was started with another config; start it again to take this one",
        )
        for name in sensors
        if name not in facts
    ]
    return found


def _from_status(status: Status) -> Finding:
    who = status.name.removeprefix(SENSOR_PREFIX)
    measured = f"as the running service reports: {status.message}"
    if who != status.name and (rate := status.values.get("rate_hz")):
        measured += f"; {rate} frames/s"
    severity = _SEVERITIES.get(status.level, "fault")
    if severity == "ok":
        return Finding("ok", who, measured, values=dict(status.values))
    remedy = "stop the service and run doctor again: it then talks to the device itself"
    if who == status.name:
        remedy = "docs/operations.md explains this line"
    return Finding(severity, who, measured, "level ok", remedy, dict(status.values))
