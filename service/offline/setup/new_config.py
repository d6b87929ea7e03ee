"""`corridor init`: a commented config for the devices that answer."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from service.config import parse_config
from service.errors import CorridorError, StorageError, UsageError
from service.offline.setup.discovery import ASK_S, Found, Wire, discover
from service.offline.writing import refuse_unwritable_file
from service.resources import CONFIG
from service.sensor_kinds import SENSOR_KINDS

REST = re.compile(r"^(?:#[^\n]*\n)*mapping:\n.*", re.MULTILINE | re.DOTALL)  # the same for all devices
EXAMPLE_DATA = "/var/lib/corridor"  # in config/vehicle.yaml
HEAD = """\
# One vehicle, written by `corridor init` for the devices that answered. Before the first drive: measure the
# position of each sensor and enter it as its `mounting`; then run `corridor doctor {path}`.
# docs/devices/<type>.md and config/sensors/<type>.yaml describe all settings of a device.

# Part of every Zenoh key (corridor/v1/{vehicle}/...) and of every file name: lower-case letters, digits and
# single _.
vehicle: {vehicle}

# One entry for each sensor; its name, of your choice, is part of its topics (/front/scan) and its frame.
sensors:
"""
MOUNTING = "    mounting: {x_m: 0.0, y_m: 0.0, yaw_deg: 0.0}   # MEASURE: base frame, x forward, y left\n"


@dataclass(frozen=True, slots=True)
class NewConfig:
    """The devices in the written config, and the wires without one."""

    out: str
    sensors: Mapping[str, Mapping[str, Any]]  # name -> type, wire and identity
    silent: Mapping[str, str]  # wire -> what is there instead

    def __str__(self) -> str:
        lines = [
            f"{name}: {facts['type']} at {facts['wire']}"
            + "".join(f", {key} {text}" for key, text in facts["identity"].items())
            for name, facts in self.sensors.items()
        ]
        lines += [f"{wire}: {words}" for wire, words in self.silent.items()]
        lines += [f"wrote {self.out}; measure the mountings in it, then: corridor doctor {self.out}"]
        return "\n".join(lines)


def write_new_config(
    wires: Sequence[Wire],
    out: Path,
    vehicle: str = "veh1",
    data: Path = Path(EXAMPLE_DATA),
    ask_s: float = ASK_S,
) -> NewConfig:
    """Query the wires and write a config for what answers.

    data   folder below which sessions and maps go

    Raises UsageError where `out` is there already or no wire is given, CorridorError where nothing answers,
    ConfigError where the vehicle's name cannot be one, StorageError.
    """
    if out.exists():
        raise UsageError(f"{out} is there already; take it away, or name another file by --out")
    if not wires:
        raise UsageError(
            "this machine has no serial port; name the hosts to ask: corridor init 192.168.0.1, say"
        )
    at_host = next(name for name, kind in SENSOR_KINDS.items() if kind.advice.at_host is not None)
    stand_in = Found(wires[0], at_host, {"host": "192.168.0.1"})
    parse_config(render({"any": stand_in}, vehicle, data, out), str(out))  # devices are queried for a minute
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"{out} cannot be written: {error.strerror or error}") from error
    refuse_unwritable_file(out)
    requested = discover(wires, ask_s)
    silent = {str(found.wire): found.words for found in requested if not found.type}
    sensors = named([found for found in requested if found.type])
    if not sensors:
        facts = "\n".join(f"  {wire}: {words}" for wire, words in silent.items())
        raise CorridorError(f"no device answers, so there is nothing to write:\n{facts}")
    text = render(sensors, vehicle, data, out)
    parse_config(text, str(out))
    try:
        with out.open("x", encoding="utf-8") as file:
            file.write(text)
    except OSError as error:
        raise StorageError(f"{out} cannot be written: {error.strerror or error}") from error
    return NewConfig(
        str(out),
        {
            name: {"type": found.type, "wire": str(found.wire), "identity": dict(found.identity or {})}
            for name, found in sensors.items()
        },
        silent,
    )


def named(found: Sequence[Found]) -> dict[str, Found]:
    """Devices by names of their types: lms, lms_2, imu ..."""
    sensors: dict[str, Found] = {}
    for one in found:
        name, number = SENSOR_KINDS[one.type].advice.name or one.type, 1
        while (free := name if number == 1 else f"{name}_{number}") in sensors:
            number += 1
        sensors[free] = one
    return sensors


def render(sensors: Mapping[str, Found], vehicle: str, data: Path, out: Path) -> str:
    """The text of a config, with comments; the sections after `sensors` as in config/vehicle.yaml."""
    parts = [HEAD.format(vehicle=vehicle, path=out)]
    for name, found in sensors.items():
        who = ", ".join(f"{key} {_in_one_line(text)}" for key, text in (found.identity or {}).items())
        parts.append(f"  {name}:" + (f"   # {who}" if who else "") + "\n")
        settings = {"type": found.type, **(found.settings or {})}
        parts += [f"    {line}\n" for line in yaml.safe_dump(settings, sort_keys=False).splitlines()]
        if "mounting" in SENSOR_KINDS[found.type].config.model_fields:
            parts.append(MOUNTING)
    example = (CONFIG / "vehicle.yaml").read_text(encoding="utf-8")
    rest = REST.search(example)
    assert rest is not None, "config/vehicle.yaml has no section mapping"
    return "".join(parts) + "\n" + rest[0].replace(EXAMPLE_DATA, str(data))


def _in_one_line(text: str) -> str:
    return " ".join("".join(char if char.isprintable() else " " for char in text).split())
