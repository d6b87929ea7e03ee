"""Files of a vehicle for its fleet, in parts: finished recordings go out, maps come in.

Below cmd/fleet/, so a client that may command may query:

    recordings                          JSON: name, bytes and modified_ns of each, oldest name first
    recordings/<name>?offset=<n>        at most PART_BYTES from there
    recordings/<name>?sha256=1          of the file, in hexadecimal
    journal?after=<Unix ns>             JSON lines: what the vehicle did then, see FleetJournal.page
    map/<name>                          JSON: sha256 of each file of the stored map; {} where there is none
    map/<name>/<file>                   JSON: bytes that have come of it
    map/<name>/<file>?offset=<n>        takes the payload as what follows; the same part twice changes nothing
    map/<name>?commit=1                 checks what came and makes it the stored map <name>
"""

import hashlib
import json
import logging
import re
import shutil
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import zenoh

from drivers.zenoh_callback import daemon_callback
from service.errors import CorridorError, InputError, words_of
from service.mapstore.files import adopt_version, is_map_folder, version_folder, versions_of
from service.mapstore.manifest import MANIFEST, read_manifest
from service.publishing.keys import vehicle_key
from service.sinks.fleet_journal import FleetJournal

log = logging.getLogger(__name__)

RECORDINGS, MAPS, JOURNAL = "cmd/fleet/recordings", "cmd/fleet/map", "cmd/fleet/journal"
PART_BYTES = 1 << 20  # of a recording, at most
MAP_PART_BYTES = 512 << 10  # below MAX_COMMAND_BYTES of the routers between
MAP_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}")
_FILE_NAME = re.compile(r"\w[\w.]{0,99}", re.ASCII)
_INCOMING = ".incoming-"  # begins the folder of a map that is not complete yet
_ABANDONED_S = 7 * 86_400.0
_KEPT_SUMS = 1000

FileRequest = tuple[
    list[str], zenoh.Parameters, bytes
]  # what stands behind the key, behind the ?, and the payload


class FleetFiles:
    """Open when constructed. recordings, maps: folders; None where there are none."""

    def __init__(
        self,
        session: zenoh.Session,
        vehicle: str,
        recordings: Path | None,
        maps: Path | None,
        journal: FleetJournal | None,
    ) -> None:
        self._recordings, self._maps, self._journal = recordings, maps, journal
        self._sums: dict[tuple[str, int, int], str] = {}
        self._queryables = []
        answers = {RECORDINGS: self._recording, MAPS: self._map, JOURNAL: self._line}
        for channel, answer in answers.items():
            root = vehicle_key(vehicle, channel)
            taken = daemon_callback(partial(self._take, root, answer), f"fleet-{channel.rpartition('/')[2]}")
            self._queryables.append(session.declare_queryable(f"{root}/**", taken))
        self._remove_abandoned()

    def close(self) -> None:
        for queryable in self._queryables:
            queryable.undeclare()  # type: ignore[no-untyped-call]

    def _take(self, root: str, answer: Callable[[FileRequest], bytes], query: zenoh.Query) -> None:
        with query:
            key = str(query.key_expr)
            if "*" in key:
                return  # a query for everything is for no file
            payload = query.payload.to_bytes() if query.payload is not None else b""
            try:
                parts = key.removeprefix(root).strip("/").split("/")
                body = answer(([part for part in parts if part], query.parameters, payload))
            except (CorridorError, OSError, ValueError) as error:
                log.warning("fleet: %s: %s", key, error)
                query.reply_err(json.dumps({"error": words_of(error)}).encode())
            else:
                query.reply(key, body)

    def _recording(self, requested: FileRequest) -> bytes:
        names, parameters, _ = requested
        if self._recordings is None:
            raise InputError("this vehicle records nothing")
        if not names:
            found = sorted(self._recordings.glob("*.mcap"))
            stats = [(path.name, path.stat()) for path in found if path.is_file()]
            listed = [{"name": n, "bytes": s.st_size, "modified_ns": s.st_mtime_ns} for n, s in stats]
            return json.dumps(listed).encode()
        path = self._recordings / names[0]
        if len(names) > 1 or not names[0].endswith(".mcap") or not path.is_file():
            raise InputError(f"{'/'.join(names)}: no finished recording of this vehicle")
        if parameters.get("sha256"):
            return self._sha256(path).encode()
        with path.open("rb") as file:
            file.seek(_number(parameters, "offset"))
            return file.read(PART_BYTES)

    def _line(self, requested: FileRequest) -> bytes:
        return b"" if self._journal is None else self._journal.page(_number(requested[1], "after"))

    def _sha256(self, path: Path) -> str:
        stat = path.stat()
        known = path.name, stat.st_size, stat.st_mtime_ns
        if known not in self._sums:
            if len(self._sums) >= _KEPT_SUMS:
                self._sums.clear()
            with path.open("rb") as file:
                self._sums[known] = hashlib.file_digest(file, "sha256").hexdigest()
        return self._sums[known]

    def _map(self, requested: FileRequest) -> bytes:
        names, parameters, payload = requested
        if self._maps is None:
            raise InputError("this vehicle stores no maps")
        if not names or MAP_NAME.fullmatch(names[0]) is None or len(names) > 2:
            raise InputError(f"{'/'.join(names)!r} is no map/<name> or map/<name>/<file>")
        folder, incoming = self._maps / names[0], self._maps / f"{_INCOMING}{names[0]}"
        if len(names) == 2:
            return _answer({"bytes": _received(incoming, names[1], parameters, payload)})
        if parameters.get("commit"):
            if is_map_folder(folder):
                raise InputError(f"{names[0]}: this vehicle has such a map already")
            try:
                adopt_version(folder, incoming)
            except InputError:
                shutil.rmtree(incoming)  # the next push would go on with what is damaged
                raise
            shutil.rmtree(incoming)
        return _answer({"files": sums_of(folder)})

    def _remove_abandoned(self) -> None:
        for folder in self._maps.glob(f"{_INCOMING}*") if self._maps is not None else ():
            if time.time() - folder.stat().st_mtime > _ABANDONED_S:
                shutil.rmtree(folder, ignore_errors=True)


def sums_of(folder: Path, number: int | None = None) -> dict[str, str]:
    """File -> SHA-256 of a version of a stored map (None: the current one), by its manifest; {} where
    there is no map. Raises InputError.
    """
    if not is_map_folder(folder):
        return {}
    number = versions_of(folder)[1] if number is None else number
    files = read_manifest(version_folder(folder, number)).files
    return {name: files[name].sha256 for name in sorted(files)}


def _received(incoming: Path, name: str, parameters: zenoh.Parameters, payload: bytes) -> int:
    """Bytes of the file that are here, after what the payload adds."""
    if _FILE_NAME.fullmatch(name) is None:
        raise InputError(f"{name!r} is no file of a map")
    path = incoming / name
    there = path.stat().st_size if path.exists() else 0
    if parameters.get("offset") is None:
        return there
    offset = _number(parameters, "offset")
    if offset > there:
        words = f"{name}: {there} bytes have come; a part at {offset} leaves a gap; is another push at work?"
        raise InputError(words)
    incoming.mkdir(parents=True, exist_ok=True)
    if name != MANIFEST:
        expected = read_manifest(incoming).files
        if name not in expected or offset + len(payload) > expected[name].bytes:
            raise InputError(f"{name}: the manifest has no such file of {offset + len(payload)} bytes")
        missing = sum(one.bytes for one in expected.values()) - sum(
            part.stat().st_size for part in incoming.iterdir()
        )
        if missing > (free := shutil.disk_usage(incoming).free):
            raise InputError(
                f"no room for this map: {missing / 1e6:.0f} MB to come, {free / 1e6:.0f} MB free"
            )
    with path.open("r+b" if path.exists() else "w+b") as file:
        file.seek(offset)
        file.truncate()
        file.write(payload)
        return file.tell()


def _number(parameters: zenoh.Parameters, name: str) -> int:
    """0 where it is left out."""
    text = parameters.get(name) or "0"
    if not (text.isascii() and text.isdigit() and len(text) < 20):
        raise InputError(f"{name}={text[:20]}: expected a number")
    return int(text)


def _answer(body: dict[str, Any]) -> bytes:
    return json.dumps(body).encode()
