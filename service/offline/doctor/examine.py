"""`corridor doctor`: examines machine, config and devices, and reports faults. It changes nothing here."""

import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from service.config import ServiceConfig, load_config
from service.errors import ConfigError
from service.offline.doctor import endpoints, folders, host
from service.offline.doctor.certificates import look_at_certificates, look_at_loaded
from service.offline.doctor.devices import Patience, examine_sensor, look_at_shared
from service.offline.doctor.findings import Finding, Report, fault, ok
from service.offline.doctor.host import look_at_cache
from service.offline.doctor.machine import Machine
from service.offline.doctor.running import ask_health, from_health


def examine(
    config_path: Path | None, machine: Machine | None = None, patience: Patience | None = None
) -> tuple[Report, int]:
    """The report, and the exit code: 0 no fault, 1 a fault, 78 the config is invalid.

    Without a config only the machine is examined. The devices are examined in parallel, each for some
    seconds; what is written to them is what the live driver writes at its start.
    """
    machine = machine or Machine()
    general = [host.look_at_clock(machine), look_at_cache(machine)]
    general += [host.look_at_rights(machine), host.look_at_unit(machine)]
    if config_path is None:
        report = Report("", tuple(general))
        return report, report.exit_code
    try:
        config = load_config(config_path)
    except ConfigError as error:
        remedy = "mend it; corridor check says when it is right"
        found = [fault("config", text, "", remedy) for text in error.faults]
        return Report(str(config_path), (*found, *general)), ConfigError.exit_code
    report = Report(
        str(config_path), (*_with_config(machine, config_path, config, patience or Patience()), *general)
    )
    return report, report.exit_code


def _with_config(
    machine: Machine, path: Path, config: ServiceConfig, patience: Patience
) -> Sequence[Finding]:
    kinds = ", ".join(f"{name} ({sensor.type})" for name, sensor in config.sensors.items())
    zenoh, running = endpoints.look_at_zenoh(machine, config)
    if running is not None:
        statuses = ask_health(running, config.vehicle, config.sinks["publishing"].secured)
        zenoh += look_at_loaded(machine, config, statuses)
        devices = from_health(running, config.vehicle, list(config.sensors), statuses)
    else:
        devices = _devices(machine, config, patience)
    return (
        ok("config", f"{path} is valid: vehicle {config.vehicle} with {kinds}"),
        *zenoh,
        *look_at_certificates(machine, config),
        *endpoints.look_at_pages(machine, config, running),
        *look_at_shared(machine, config.sensors),
        *devices,
        *folders.look_at_folders(machine, config),
        *folders.look_at_map_to_load(machine, config),
        folders.look_at_disk(machine, config),
        *folders.look_at_leftovers(machine, config),
    )


def _devices(machine: Machine, config: ServiceConfig, patience: Patience) -> list[Finding]:
    """Findings on all sensors, examined in parallel."""
    stop = threading.Event()
    with ThreadPoolExecutor(max_workers=len(config.sensors), thread_name_prefix="doctor") as workers:
        try:
            requested = [
                workers.submit(examine_sensor, machine, sensor, patience, stop)
                for sensor in config.sensors.values()
            ]
            return [finding for future in requested for finding in future.result()]
        finally:
            stop.set()  # Ctrl-C: let the devices go in good order
