"""Stored maps: one folder a map, a sub-folder a version, and a link that says which one counts.

    map.yaml, map.pgm, map.png -> current/...     what other programs read
    geo.json -> current/geo.json                  where GNSS anchors the map
    current -> v000012                            switched by one rename, from the old map to the new
    v000012/   tiles.npz, map.yaml, map.pgm, map.png, geo.json if there is one, graph.npz and points_*.npz
               where mapping can go on, and manifest.json: SHA-256 of these and of itself

A version is written beside the others under a name that nobody reads, synced to the disk, then renamed. So a
kill or a power cut at any moment leaves the last good one. The newest few are kept, each that an edit by hand
made or began with, and each with a file "kept" in it: a session began there, whose replay needs it.
"""

import fcntl
import hashlib
import json
import logging
import os
import re
import shutil
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivers.counted import counted
from service.errors import InputError, StorageError, words_of
from service.geometry.geo_reference import GeoReference
from service.mapper.saved_graph import SavedGraph
from service.mapstore.annotated import PALETTE, annotated
from service.mapstore.arrays import write_arrays
from service.mapstore.edits import Edit, Version, edit_from_json, edit_to_json, kept_for_ever
from service.mapstore.geo_file import GEO_FILE, read_geo, write_geo
from service.mapstore.graph_files import GRAPH_FILE, link_graph, read_graph, ways_of, write_graph
from service.mapstore.links import CURRENT, UNFINISHED, point, point_for_others, point_to_current
from service.mapstore.picture import Picture, picture_of_tiles
from service.mapstore.png import write_png
from service.mapstore.ros_map import write_ros_map
from service.outputs import TileUpdate
from service.readable import refuse_unreadable
from service.version import VERSION
from service.writable import sync

log = logging.getLogger(__name__)

FORMAT = 3
# 1 has no graph: it can be shown and exported, and mapping cannot go on in it. 2 has nothing made by hand.
READ_FORMATS = (1, 2, 3)
KEEP_VERSIONS = 3
FOR_OTHERS = ("map.yaml", "map.pgm", "map.png")
_CONTENT = (*FOR_OTHERS, "tiles.npz")
_VERSION_NAME = re.compile(r"v(\d{6,})")
_KEPT = "kept"  # in the folder of a version: why it is never removed


@dataclass(frozen=True, slots=True, eq=False)
class StoredMap:
    """A map read back. `problems` says what was damaged and passed over; empty when all is well."""

    number: int  # of the version in its folder, from 1
    about: dict[str, str]
    saved_ns: int  # Unix time
    tiles: list[TileUpdate]
    problems: list[str]
    geo: GeoReference | None = None  # where it lies on the earth; None: that is not known
    graph: SavedGraph | None = None  # with which mapping goes on; None: it cannot
    edit: Edit | None = None  # that made this version; None: a session, a replay or a merge did
    digest: str = ""  # SHA-256 of its manifest, so of all its content


def save_map(
    folder: Path,
    tiles: Sequence[TileUpdate],
    saved_ns: int,
    about: Mapping[str, str] | None = None,
    geo: GeoReference | None = None,
    graph: SavedGraph | Path | None = None,
    edit: Edit | None = None,
) -> int | None:
    """Store `tiles` as the next version of the map in `folder`; its number, or None where there are no tiles.

    saved_ns is Unix time; `about` (vehicle, profile ...), `geo` and `graph` are kept with the map, and
    KEEP_VERSIONS versions of it. A graph may be the folder in which GraphFolder wrote it. `edit` says that
    the version was made by hand.
    Raises StorageError: no room, no rights, another writer; the version before stays what it was.
    """
    if not any(tile.level == 0 for tile in tiles):
        return None

    def write(new: Path) -> list[str]:
        picture = _write_content(new, tiles, geo)
        names = [*_CONTENT, *([GEO_FILE] if geo is not None else [])]
        if isinstance(graph, Path):
            names += link_graph(graph, new)
        elif graph is not None:
            names += write_graph(new, graph, folder / _name(max(_versions(folder), default=0)))
        write_png(new / "map.png", annotated(picture, ways_of(new)), PALETTE)
        return names

    return _publish(folder, write, saved_ns, dict(about or {}), edit)


def restore_version(folder: Path, number: int, saved_ns: int, edit: Edit) -> int:
    """Make what version `number` holds the next version, too; its number. saved_ns: Unix time.

    Raises InputError where that version is not there or damaged, StorageError as save_map.
    """
    stored = load_map(folder, number)
    old = folder / _name(number)
    names = list(_checked_manifest(old)["files"])

    def write(new: Path) -> list[str]:
        for name in names:
            os.link(old / name, new / name)
        return names

    return _publish(folder, write, saved_ns, stored.about, edit)


def versions_of(folder: Path) -> tuple[list[Version], int, list[str]]:
    """The versions by rising number, the number of the current one, and what is damaged of the others.

    Raises InputError where `folder` holds no map that can be read.
    """
    versions: list[Version] = []
    problems: list[str] = []
    for number in sorted(_versions_read(folder)):
        try:
            manifest = _checked_manifest(folder / _name(number))
        except InputError as error:
            problems.append(str(error))
        else:
            edit = _edit_of(folder / _name(number), manifest)
            versions.append(Version(number, manifest["saved_ns"], manifest["about"], edit))
    if not versions:
        raise _no_map(folder, problems)
    at = _number(_by_preference(folder)[0])
    return versions, at if at in {v.number for v in versions} else versions[-1].number, problems


def load_map(folder: Path, number: int | None = None) -> StoredMap:
    """Read version `number`; None: the current one, or the newest that is whole, with the damage in
    `problems`.

    Raises InputError where there is none.
    """
    if number is not None:
        if number not in (there := sorted(_versions_read(folder))):
            raise InputError(
                f"{folder}: no version {number}; there are {', '.join(map(str, there)) or 'none'}"
            )
        return _load(folder / _name(number), [])
    problems: list[str] = []
    for name in _by_preference(folder):
        try:
            stored = _load(folder / name, problems)
        except InputError as error:
            log.warning("%s", error)
            problems.append(str(error))
            continue
        return stored
    raise _no_map(folder, problems)


def check_versions(folder: Path) -> tuple[list[int], list[str]]:
    """Numbers of the versions that are whole, and what is damaged of the others, each by its file.

    Raises InputError where `folder` holds no map.
    """
    whole: list[int] = []
    problems: list[str] = []
    for number in sorted(_versions_read(folder)):
        try:
            _load(folder / _name(number), [])
        except InputError as error:
            problems.append(str(error))
        else:
            whole.append(number)
    if not whole and not problems:
        raise _no_map(folder, [])
    return whole, problems


def _no_map(folder: Path, problems: Sequence[str]) -> InputError:
    """Why no map can be read in `folder`: what is damaged, or what stands there instead."""
    why = ""
    try:
        refuse_unreadable(folder)
        if is_map_folder(folder / "map"):
            why = f"; the map of this result is {folder / 'map'}"
    except InputError as error:
        why = str(error).removeprefix(str(folder))
    return InputError("\n  ".join([f"{folder}: no stored map that can be read{why}", *problems]))


def version_folder(folder: Path, number: int) -> Path:
    return folder / _name(number)


def is_map_folder(folder: Path) -> bool:
    return folder.is_dir() and bool(_versions_read(folder))


def keep_version(folder: Path, number: int, why: str) -> None:
    """Never remove this version when later ones are saved. Raises StorageError."""
    kept = folder / _name(number) / _KEPT
    try:
        if not kept.exists():
            kept.write_text(f"{why}\n", encoding="utf-8")
    except OSError as error:
        raise StorageError(f"{kept}: {error.strerror}") from error


def has_version(folder: Path, number: int, digest: str) -> bool:
    """Whether version `number` is there and is the one of that digest."""
    try:
        return _digest(_checked_manifest(folder / _name(number))) == digest
    except InputError:
        return False


def _publish(
    folder: Path,
    write: Callable[[Path], list[str]],
    saved_ns: int,
    about: dict[str, str],
    edit: Edit | None,
) -> int:
    """Make a version of what `write` puts into a new folder, and names; its number. Raises StorageError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with _only_writer(folder):
            return _publish_alone(folder, write, saved_ns, about, edit)
    except OSError as error:
        before = "; the version before is untouched" if _versions_read(folder) else ""
        raise StorageError(f"cannot save the map to {folder}: {words_of(error)}{before}") from error


def _publish_alone(
    folder: Path,
    write: Callable[[Path], list[str]],
    saved_ns: int,
    about: dict[str, str],
    edit: Edit | None,
) -> int:
    for leftover in folder.glob(UNFINISHED + "*"):
        _remove(leftover)
    versions = [folder / _name(number) for number in _versions(folder)]
    point_to_current(folder, versions)
    point_for_others(folder, FOR_OTHERS, versions)
    number = max(_versions(folder), default=0) + 1
    new = folder / f"{UNFINISHED}{number}"
    try:
        new.mkdir()
        names = write(new)
        has_geo = GEO_FILE in names
        if has_geo:
            point_for_others(folder, [GEO_FILE], versions)
        _write_manifest(new, names, saved_ns, about, edit)
        sync(new)
        new.rename(folder / _name(number))
    except (OSError, StorageError):
        shutil.rmtree(new, ignore_errors=True)
        raise
    sync(folder)
    point(folder / CURRENT, _name(number))
    if not has_geo and (folder / GEO_FILE).is_symlink():
        (folder / GEO_FILE).unlink()
    for old in _too_old(folder):
        # Half of it is no version: the next save removes the rest.
        gone = folder / f"{UNFINISHED}{_name(old)}"
        with suppress(OSError):  # again with the next save
            (folder / _name(old)).rename(gone)
            shutil.rmtree(gone)
    return number


def _too_old(folder: Path) -> list[int]:
    """Numbers of the versions that go: neither among the newest, nor made or begun with by an edit, nor kept
    by keep_version.

    One whose manifest cannot be read stays: nobody knows what it was.
    """
    old = sorted(_versions(folder))[:-KEEP_VERSIONS]
    if not old:
        return []
    known, _, _ = versions_of(folder)
    kept = kept_for_ever(known)
    gone = [version.number for version in known if version.number in old and version.number not in kept]
    return [number for number in gone if not (folder / _name(number) / _KEPT).exists()]


def _write_content(
    new: Path,
    tiles: Sequence[TileUpdate],
    geo: GeoReference | None,
) -> Picture:
    """The picture of the map, which other programs read."""
    if geo is not None:
        write_geo(new / GEO_FILE, geo)
    with (new / "tiles.npz").open("wb") as file:
        arrays = {
            "index": np.array([(t.level, t.ix, t.iy, t.version) for t in tiles], dtype=np.int64),
            "cell_m": np.array([t.cell_m for t in tiles]),
            "cells": np.stack([t.cells for t in tiles]),
        }
        write_arrays(file, arrays)
    picture = picture_of_tiles(tiles)
    write_ros_map(new / "map.pgm", new / "map.yaml", picture)
    return picture


def _write_manifest(
    new: Path, names: Sequence[str], saved_ns: int, about: dict[str, str], edit: Edit | None
) -> None:
    manifest = {
        "format": FORMAT,
        "corridor": VERSION,
        "saved_ns": saved_ns,
        "about": about,
        "edit": None if edit is None else edit_to_json(edit),
        "files": {
            name: {"bytes": (new / name).stat().st_size, "sha256": _sha256(new / name)} for name in names
        },
    }
    text = json.dumps({**manifest, "sha256": _digest(manifest)}, indent=1)
    (new / "manifest.json").write_text(text + "\n", encoding="utf-8")
    for path in new.iterdir():
        sync(path)


def _load(version: Path, problems: list[str]) -> StoredMap:
    manifest = _checked_manifest(version)
    for name, expected in manifest["files"].items():
        path = version / name
        try:
            found = {"bytes": path.stat().st_size, "sha256": _sha256(path)}
        except OSError as error:
            raise InputError(f"{path}: {error.strerror}") from error
        if found != expected:
            raise InputError(
                f"{path}: {counted(found['bytes'], 'byte')}, not the {expected['bytes']} saved: damaged"
            )
    try:
        with np.load(version / "tiles.npz", allow_pickle=False) as arrays:
            index, cell_m, cells = arrays["index"], arrays["cell_m"], arrays["cells"]
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise InputError(f"{version / 'tiles.npz'}: {words_of(error)}") from error
    cells.setflags(write=False)
    tiles = [
        TileUpdate(level, ix, iy, version_of_tile, size_m, square)
        for (level, ix, iy, version_of_tile), size_m, square in zip(
            index.tolist(), cell_m.tolist(), cells, strict=True
        )
    ]
    geo = read_geo(version / GEO_FILE) if GEO_FILE in manifest["files"] else None
    graph = read_graph(version) if GRAPH_FILE in manifest["files"] else None
    return StoredMap(
        _number(version.name),
        manifest["about"],
        manifest["saved_ns"],
        tiles,
        problems,
        geo,
        graph,
        _edit_of(version, manifest),
        _digest(manifest),
    )


def _edit_of(version: Path, manifest: Mapping[str, Any]) -> Edit | None:
    try:
        return edit_from_json(manifest.get("edit"))
    except (KeyError, TypeError) as error:
        raise InputError(f"{version / 'manifest.json'}: its edit is damaged: {error!r}") from error


def _checked_manifest(version: Path) -> dict[str, Any]:
    path = version / "manifest.json"
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: damaged: {words_of(error)}") from error
    if not isinstance(manifest, dict):
        raise InputError(f"{path}: damaged: no JSON object")
    if manifest.pop("sha256", None) != _digest(manifest):
        raise InputError(f"{path}: damaged: its own checksum does not fit")
    if manifest["format"] not in READ_FORMATS:
        raise InputError(
            f"{path}: format {manifest['format']} of corridor {manifest['corridor']}; "
            f"this is corridor {VERSION}, which reads the formats up to {FORMAT}"
        )
    checked: dict[str, Any] = manifest
    return checked


def _by_preference(folder: Path) -> list[str]:
    """Names of versions: the current one, then the others, newest first."""
    names = [_name(number) for number in sorted(_versions_read(folder), reverse=True)]
    try:
        current = os.readlink(folder / CURRENT)
    except (OSError, ValueError):
        return names
    return sorted(names, key=lambda name: name != current)


def _versions(folder: Path) -> list[int]:
    """In no order. Raises OSError and ValueError where the system refuses the path."""
    return [_number(path.name) for path in folder.glob("v*") if _VERSION_NAME.fullmatch(path.name)]


def _versions_read(folder: Path) -> list[int]:
    """As _versions; none where the system refuses the path, of which _no_map says why."""
    try:
        return _versions(folder)
    except (OSError, ValueError):
        return []


def _name(number: int) -> str:
    return f"v{number:06d}"


def _number(name: str) -> int:
    return int(name.removeprefix("v"))


@contextmanager
def _only_writer(folder: Path) -> Iterator[None]:
    with (folder / ".lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise StorageError(
                f"{folder}: another process is writing this map; stop one of the two"
            ) from error
        yield


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink()


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _digest(manifest: Mapping[str, object]) -> str:
    return hashlib.sha256(json.dumps(manifest, sort_keys=True).encode()).hexdigest()
