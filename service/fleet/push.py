"""Brings a version of a stored map to vehicles: to all first, then all begin in it, or none does."""

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zenoh

from service.errors import CorridorError, InputError, UsageError
from service.fleet.queries import RefusedError, ask, ask_json, for_each, namesakes
from service.fleet.vehicles import present, read_vehicles
from service.mapstore.files import load_map, version_folder
from service.mapstore.manifest import MANIFEST, read_manifest
from service.sinks.fleet_files import MAP_NAME, MAP_PART_BYTES, MAPS, sums_of

log = logging.getLogger(__name__)

LOAD_S = 120.0  # a map of a large site, on a vehicle that maps meanwhile
Progress = Callable[[str], None]  # words


@dataclass(frozen=True, slots=True)
class Pushed:
    """Result at one vehicle: "active", "brought", "not brought", "as before" or "unknown"."""

    vehicle: str
    state: str
    error: str = ""

    def __str__(self) -> str:
        return f"{self.vehicle}: {self.state}" + (f": {self.error}" if self.error else "")


def push(
    session: zenoh.Session,
    folder: Path,
    number: int | None,
    vehicles: Sequence[str],
    name: str | None = None,
    progress: Progress = lambda words: None,
) -> list[Pushed]:
    """A new map `name` (default: of the folder, with its version) on each vehicle; all "active", or an error
    at one at least and none active. Nothing that a vehicle has is changed.

    Raises InputError where the map is damaged or mapping cannot go on in it; UsageError.
    """
    stored = load_map(folder, number)
    if stored.graph is None:
        raise InputError(f"{folder}: this map holds what was shown; no session can begin in it")
    name = name or f"{folder.resolve().name}_v{stored.number:06d}"
    if MAP_NAME.fullmatch(name) is None:
        raise UsageError(f"{name!r} is no name of a map; give one with --name")
    source = version_folder(folder, stored.number)
    before = _ready(session, vehicles)
    if any(isinstance(one, CorridorError) for one in before.values()):
        return [
            Pushed(vehicle, "as before", str(why) if isinstance(why, CorridorError) else "")
            for vehicle, why in before.items()
        ]

    def bring(vehicle: str) -> None:
        _bring(session, vehicle, source, name)
        progress(f"{vehicle} has it")

    brought = for_each(vehicles, bring)
    if any(brought.values()):
        return [
            Pushed(one, "not brought" if why else "brought", str(why or "")) for one, why in brought.items()
        ]
    again = time.time_ns()  # for the ids of the commands, so that each is carried out once
    begun = for_each(vehicles, lambda vehicle: _load(session, vehicle, name, f"push-{again}"))
    failed = {one: why for one, why in begun.items() if isinstance(why, CorridorError)}
    if not failed:
        return [Pushed(vehicle, "active") for vehicle in begun]

    def back(vehicle: str) -> None:
        why, answer = failed.get(vehicle), begun[vehicle]
        if isinstance(why, RefusedError) and "the map is loaded" not in str(why):
            return  # the map before stays
        folder = answer.get("folder_before") if isinstance(answer, dict) else None
        _load(session, vehicle, Path(folder).name if folder else str(before[vehicle]), f"back-{again}")

    returned = for_each(vehicles, back)
    return [
        Pushed(one, "unknown" if why else "as before", "; ".join(str(e) for e in (failed.get(one), why) if e))
        for one, why in returned.items()
    ]


def _ready(session: zenoh.Session, vehicles: Sequence[str]) -> dict[str, str | CorridorError]:
    """The map that each is in, by name; or why it cannot take another."""
    here = present(session)
    ready: dict[str, str | CorridorError] = {}
    for vehicle in read_vehicles(session, vehicles):
        if (why := namesakes(here.get(vehicle.name, ()))) is not None:
            ready[vehicle.name] = why
        elif vehicle.state == "silent":
            ready[vehicle.name] = RefusedError("it does not answer")
        else:
            ready[vehicle.name] = vehicle.map
    return ready


def _bring(session: zenoh.Session, vehicle: str, source: Path, name: str) -> None:
    """All files of the version, from where an earlier try ended."""
    expected = sums_of(source.parent, int(source.name[1:]))
    there = ask_json(session, vehicle, f"{MAPS}/{name}")["files"]
    if there == expected:
        return
    if there:
        raise RefusedError(f"{vehicle}: it has another map {name}; give a new name with --name")
    manifest = (source / MANIFEST).read_bytes()
    ask(session, vehicle, f"{MAPS}/{name}/{MANIFEST}?offset=0", manifest)
    for file in read_manifest(source).files:
        channel = f"{MAPS}/{name}/{file}"
        content = (source / file).read_bytes()
        at = min(int(ask_json(session, vehicle, channel)["bytes"]), len(content))
        for offset in range(at, max(len(content), 1), MAP_PART_BYTES):  # an empty file, too, is one part
            ask(session, vehicle, f"{channel}?offset={offset}", content[offset : offset + MAP_PART_BYTES])
    if ask_json(session, vehicle, f"{MAPS}/{name}?commit=1")["files"] != expected:
        raise RefusedError(
            f"{vehicle}: its files of {name} are not those that were sent; push it as another --name"
        )


def _load(session: zenoh.Session, vehicle: str, name: str, identity: str) -> dict[str, Any]:
    """Its answer, once the session has begun in that map; requested with one id, it begins once."""
    until_s = time.monotonic() + LOAD_S
    while True:
        try:
            answer: dict[str, Any] = ask_json(session, vehicle, "cmd/load_map", {"map": name, "id": identity})
            return answer
        except RefusedError as error:
            if "taken up, but not finished" not in str(error) or time.monotonic() > until_s:
                raise
