"""Where sessions and maps go: can they be written, is there room, did a writer die."""

import tempfile
from pathlib import Path

from drivers.counted import counted
from service.config import ServiceConfig
from service.errors import CorridorError
from service.mapstore.begin_in import stored_for
from service.offline.doctor.findings import Finding, fault, note, ok
from service.offline.doctor.machine import Machine
from service.recording.mcap_file import is_locked

ROOM_SESSIONS = 2  # files of the largest size that should still fit


def look_at_folders(machine: Machine, config: ServiceConfig) -> list[Finding]:
    return [
        _folder(machine, "recording", "recording.directory", config.sinks["recording"].directory),
        _folder(machine, "map", "map.directory", config.sinks["map"].directory),
    ]


def _folder(machine: Machine, who: str, key: str, folder: Path) -> Finding:
    path = machine.path(folder)
    there = nearest_parent(path)
    if not there.is_dir():
        return fault(who, f"{folder} lies under {there}, which is a file", "a folder", f"change {key}")
    if reason := cannot_write(there):
        unit = " (or start the service by its unit, which makes /var/lib/corridor)"
        return fault(
            who,
            f"user {machine.user} cannot write {folder}: {reason}",
            "a folder to write to",
            f"sudo install -d -o {machine.user} {folder}{unit}, or change {key}",
        )
    return ok(who, f"{folder} can be written" if there == path else f"{folder} can be made in {there}")


def look_at_map_to_load(machine: Machine, config: ServiceConfig) -> list[Finding]:
    """Finding on the map of map.load, read as a session reads it; none without the setting."""
    if config.begin_in is None:
        return []
    try:
        stored = stored_for(machine.path(config.begin_in), config.mapping)
    except CorridorError as error:
        return [
            fault(
                "map",
                f"map.load: {error}",
                "the folder of a stored map that a session can begin in",
                "name such a folder in map.load (corridor map info FOLDER shows one), or take map.load out",
            )
        ]
    return [ok("map", f"a session begins in version {stored.number} of {config.begin_in}")]


def look_at_disk(machine: Machine, config: ServiceConfig) -> Finding:
    folder = machine.path(config.sinks["recording"].directory)
    there = nearest_parent(folder)
    keep, session_gb = config.sinks["recording"].keep_free_gb, config.sinks["recording"].rotate_mb / 1e3
    free = machine.free_bytes(there) / 1e9
    if free < keep:
        return fault(
            "disk",
            f"{free:.1f} GB free at {there}; recording pauses",
            f"more than recording.keep_free_gb {keep:g} GB",
            f"move sessions away from {config.sinks['recording'].directory}, or take another disk",
        )
    if free < keep + ROOM_SESSIONS * session_gb:
        return note(
            "disk",
            f"{free:.1f} GB free at {there}: {free - keep:.1f} GB more and recording pauses",
            f"move sessions away from {config.sinks['recording'].directory}",
            f"room for {ROOM_SESSIONS} sessions of {session_gb:g} GB beside keep_free_gb {keep:g} GB",
        )
    return ok("disk", f"{free:.1f} GB free at {there}, {keep:g} GB are kept", free_gb=round(free, 2))


def look_at_leftovers(machine: Machine, config: ServiceConfig) -> list[Finding]:
    folder = machine.path(config.sinks["recording"].directory)
    left = [path for path in sorted(folder.glob("*.mcap.active")) if not _is_being_written(path)]
    if not left:
        return []
    names = ", ".join(path.name for path in left)
    return [
        note(
            "recording",
            f"{counted(len(left), 'session')} whose writer died: {names}",
            "the next start of the service mends them; by hand: corridor recover FILE",
        )
    ]


def _is_being_written(path: Path) -> bool:
    try:
        return is_locked(path)
    except OSError:  # not ours to read
        return False


def cannot_write(folder: Path) -> str:
    """Why, "" where we can. Tried rather than looked up: root has every right, yet a read-only mount
    refuses.
    """
    try:
        with tempfile.TemporaryFile(dir=folder):
            return ""
    except OSError as error:
        return error.strerror or str(error)


def nearest_parent(path: Path) -> Path:
    """The path itself, or the lowest folder above it that is there."""
    return next(parent for parent in (path, *path.absolute().parents) if parent.exists())
