"""Stored maps: one folder a map, a sub-folder a version, and a link to the one in use.

    map.yaml, map.pgm, map.png -> current/...     what other programs read
    geo.json -> current/geo.json                  where GNSS anchors the map
    current -> v000012                            switched by one rename, from the old map to the new
    v000012/   tiles.npz, map.yaml, map.pgm, map.png, geo.json if there is one, graph.npz and points_*.npz
               where mapping can go on, and manifest.json: SHA-256 of these and of itself

A version is written beside the others under a name that no one reads, synced to the disk, then renamed. So a
kill or a power cut at any moment leaves the last good one. The newest few are kept, each that an edit by hand
made or began with, and each with a file "kept" in it: a session began there, whose replay needs it.
"""

import fcntl
import logging
import os
import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from service.errors import InputError, StorageError, words_of
from service.geometry.geo_reference import GeoReference
from service.mapper.saved_graph import SavedGraph
from service.mapstore.annotated import PALETTE, annotated
from service.mapstore.arrays import read_arrays, write_arrays
from service.mapstore.edits import Edit, Version, kept_for_ever
from service.mapstore.geo_file import GEO_FILE, read_geo, write_geo
from service.mapstore.graph_files import GRAPH_FILE, link_graph, read_graph, segment_paths, write_graph
from service.mapstore.links import CURRENT, UNFINISHED, point, point_for_others, point_to_current
from service.mapstore.manifest import check_files, read_manifest, write_manifest
from service.mapstore.picture import picture_of_tiles
from service.mapstore.png import write_png
from service.mapstore.ros_map import write_ros_map
from service.outputs import TileUpdate
from service.readable import refuse_unreadable
from service.writable import sync

log = logging.getLogger(__name__)

KEEP_VERSIONS = 3
FOR_OTHERS = ("map.yaml", "map.pgm", "map.png")
TILES_FILE = "tiles.npz"
MAX_TILE_INDEX = 1 << 31
_VERSION_NAME = re.compile(r"v(\d{6,})")
_KEPT = "kept"  # in the folder of a version: why it is never removed
ReadT = TypeVar("ReadT")


@dataclass(frozen=True, slots=True, eq=False)
class StoredMap:
    """A map read back. `problems` lists what was damaged and passed over; empty when all is well."""

    number: int  # of the version in its folder, from 1
    about: dict[str, str]
    saved_ns: int  # Unix time
    tiles: list[TileUpdate]
    problems: list[str]
    geo: GeoReference | None = None  # where it lies on the earth; None: that is not known
    graph: SavedGraph | None = None  # with which mapping goes on; None: it cannot
    edit: Edit | None = None  # that made this version; None: a session, a replay or a merge did
    digest: str = ""  # SHA-256 of its manifest, so of all its content

    @property
    def cell_m(self) -> float:
        """Of the finest level."""
        return next(tile.cell_m for tile in self.tiles if tile.level == 0)


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
    KEEP_VERSIONS versions of it. A graph may be the folder in which GraphFolder wrote it. `edit` records that
    the version was made by hand.
    Raises StorageError: no room, no rights, another writer; the version before stays what it was.
    """
    if not any(tile.level == 0 for tile in tiles):
        return None

    def write(new: Path) -> list[str]:
        picture = picture_of_tiles(tiles)
        write_ros_map(new / "map.pgm", new / "map.yaml", picture)
        with (new / TILES_FILE).open("wb") as file:
            arrays = {
                "index": np.array([(t.level, t.ix, t.iy, t.version) for t in tiles], dtype=np.int64),
                "cell_m": np.array([t.cell_m for t in tiles]),
                "cells": np.stack([t.cells for t in tiles]),
            }
            write_arrays(file, arrays)
        names = [*FOR_OTHERS, TILES_FILE]
        if geo is not None:
            write_geo(new / GEO_FILE, geo)
            names.append(GEO_FILE)
        if isinstance(graph, Path):
            names += link_graph(graph, new)
        elif graph is not None:
            names += write_graph(new, graph, folder / _name(max(_versions(folder), default=0)))
        write_png(new / "map.png", annotated(picture, segment_paths(new)), PALETTE)
        return names

    return _publish(folder, write, saved_ns, about or {}, edit)


def restore_version(folder: Path, number: int, saved_ns: int, edit: Edit) -> int:
    """Make what version `number` holds the next version, too; its number. saved_ns: Unix time.

    Raises InputError where that version is not there or damaged, StorageError as save_map.
    """
    stored = load_map(folder, number)
    return _publish(folder, _linked(folder / _name(number)), saved_ns, stored.about, edit)


def adopt_version(folder: Path, source: Path) -> None:
    """Make the files that lie in `source` beside their manifest the next version of the map in `folder`. They
    are linked: the same disk.

    Raises InputError where one is missing or damaged, StorageError as save_map.
    """
    manifest = read_manifest(source)
    check_files(source, manifest)
    _publish(folder, _linked(source), manifest.saved_ns, manifest.about, manifest.edit)


def _linked(source: Path) -> Callable[[Path], list[str]]:
    """Links all files of a version to another folder; their names. Raises InputError."""
    names = list(read_manifest(source).files)

    def write(new: Path) -> list[str]:
        for name in names:
            os.link(source / name, new / name)
        return names

    return write


def versions_of(folder: Path) -> tuple[list[Version], int, list[str]]:
    """The versions by rising number, the number of the current one, and what is damaged of the others.

    Raises InputError where `folder` holds no map that can be read.
    """
    read, problems = _each(folder, read_manifest)
    versions = [Version(number, one.saved_ns, one.about, one.edit) for number, one in read.items()]
    if not versions:
        raise _no_map(folder, problems)
    at = _number(_by_preference(folder)[0])
    return versions, at if at in {v.number for v in versions} else versions[-1].number, problems


def load_map(folder: Path, number: int | None = None) -> StoredMap:
    """Read version `number`; None: the current one, or the newest that is complete, with the damage in
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
            return _load(folder / name, problems)
        except InputError as error:
            log.warning("%s", error)
            problems.append(str(error))
    raise _no_map(folder, problems)


def check_versions(folder: Path) -> tuple[list[int], list[str]]:
    """Numbers of the versions that are complete, and what is damaged of the others, each by its file.

    Raises InputError where `folder` holds no map.
    """
    complete, problems = _each(folder, lambda version: _load(version, []).number)
    if not complete and not problems:
        raise _no_map(folder, [])
    return list(complete), problems


def _each(folder: Path, read: Callable[[Path], ReadT]) -> tuple[dict[int, ReadT], list[str]]:
    """What `read` gives of each version, by rising number; and why it gave nothing of the others."""
    found: dict[int, ReadT] = {}
    problems: list[str] = []
    for number in sorted(_versions_read(folder)):
        try:
            found[number] = read(folder / _name(number))
        except InputError as error:
            problems.append(str(error))
    return found, problems


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


def newest_digest(folder: Path) -> str:
    """That of the version that counts, as of StoredMap; only its manifest is read. Raises InputError."""
    if not (names := _by_preference(folder)):
        raise _no_map(folder, [])
    return read_manifest(folder / names[0]).digest


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
        return read_manifest(folder / _name(number)).digest == digest
    except InputError:
        return False


def _publish(
    folder: Path,
    write: Callable[[Path], list[str]],
    saved_ns: int,
    about: Mapping[str, str],
    edit: Edit | None,
) -> int:
    """Make a version of what `write` puts into a new folder, and names; its number. Raises StorageError."""
    with only_writer(folder):
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
            write_manifest(new, names, saved_ns, about, edit)
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

    One whose manifest cannot be read stays: no one knows what it was.
    """
    old = sorted(_versions(folder))[:-KEEP_VERSIONS]
    if not old:
        return []
    known, _, _ = versions_of(folder)
    kept = kept_for_ever(known)
    gone = [version.number for version in known if version.number in old and version.number not in kept]
    return [number for number in gone if not (folder / _name(number) / _KEPT).exists()]


def _load(version: Path, problems: list[str]) -> StoredMap:
    manifest = read_manifest(version)
    check_files(version, manifest)
    tiles = _tiles(version / TILES_FILE, read_arrays(version / TILES_FILE))
    geo = read_geo(version / GEO_FILE) if GEO_FILE in manifest.files else None
    graph = read_graph(version, manifest.files) if GRAPH_FILE in manifest.files else None
    number, about = _number(version.name), manifest.about
    return StoredMap(
        number, about, manifest.saved_ns, tiles, problems, geo, graph, manifest.edit, manifest.digest
    )


def _tiles(path: Path, arrays: Mapping[str, npt.NDArray[Any]]) -> list[TileUpdate]:
    try:
        index, cell_m, cells = arrays["index"], arrays["cell_m"], arrays["cells"]
    except KeyError as error:
        raise InputError(f"{path}: it holds no {error}") from error
    count, edge = len(cells), cells.shape[-1]
    shapes = [(array.dtype.kind, array.dtype.itemsize, array.shape) for array in (index, cell_m, cells)]
    if shapes != [("i", 8, (count, 4)), ("f", 8, (count,)), ("i", 1, (count, edge, edge))]:
        raise InputError(f"{path}: its arrays are no tiles: {shapes}")
    if not (np.isfinite(cell_m).all() and (cell_m > 0.0).all() and (np.abs(index) < MAX_TILE_INDEX).all()):
        raise InputError(f"{path}: tiles without a place or a size")
    cells.setflags(write=False)
    return [
        TileUpdate(level, ix, iy, version, size_m, square)
        for (level, ix, iy, version), size_m, square in zip(
            index.tolist(), cell_m.tolist(), cells, strict=True
        )
    ]


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
    """As _versions; none where the system refuses the path, of which _no_map gives the reason."""
    try:
        return _versions(folder)
    except (OSError, ValueError):
        return []


def _name(number: int) -> str:
    return f"v{number:06d}"


def _number(name: str) -> int:
    return int(name.removeprefix("v"))


@contextmanager
def only_writer(folder: Path, of: Path | None = None) -> Iterator[None]:
    """Makes the folder, which is that of the map, or one for work beside the map in `of`. Raises
    StorageError, also for each OSError inside.
    """
    of = of or folder
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with (path := folder / ".lock").open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if not path.exists():  # who held it has just removed it
                    raise BlockingIOError
            except BlockingIOError as error:
                raise StorageError(
                    f"{of}: another process is writing this map; stop one of the two"
                ) from error
            yield
    except OSError as error:
        before = "; the version before is untouched" if _versions_read(of) else ""
        raise StorageError(f"cannot save the map to {of}: {words_of(error)}{before}") from error


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink()
