"""Stored sessions and maps: list, rename, delete, undo, view, export. Blocks; no network.

What is deleted goes to `.deleted/` beside it, from where `undo` brings it back; `purge` erases it for good.
"""

import os
import re
import secrets
import shutil
import threading
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from service.errors import words_of
from service.web.jobs import CommandProcess, ResourceError, SessionMapProcess

Kind = Literal["session", "map"]

FORMATS: Mapping[Kind, tuple[str, ...]] = {  # the first is what is stored; the others are exports of it
    "session": ("mcap", "tum", "csv", "png", "pgm", "geotiff", "svg", "dxf", "ply", "pcd", "geojson", "kml"),
    "map": ("zip", "png", "pgm", "geotiff", "svg", "dxf", "ply", "pcd", "geojson"),
}
SUFFIXES = {"geotiff": "tif"}  # of formats that are called otherwise than their files
MAX_LISTED = 500  # of a kind, newest first
GRAPH_FILE = Path("current", "graph.npz")  # of a map that a session can begin in
DELETED = ".deleted"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,99}")


@dataclass(frozen=True, slots=True)
class Download:
    """A file to be handed out; `scratch` is removed afterwards."""

    path: Path
    name: str
    scratch: Path | None = None

    def clean_up(self) -> None:
        if self.scratch is not None:
            shutil.rmtree(self.scratch, ignore_errors=True)


class Resources:
    """Thread-safe.

    folders    where each kind lies
    in_use     paths that the service itself writes to now
    scratch    folder for unfinished exports; made when it is needed
    """

    def __init__(
        self, folders: Mapping[Kind, Path], in_use: Callable[[], Collection[Path]], scratch: Path
    ) -> None:
        self._folders = folders
        self._in_use = in_use
        self._scratch = scratch
        self._lock = threading.Lock()
        self._working = threading.Lock()  # one export at a time: the vehicle has other work
        self._deleted: dict[str, tuple[Kind, str]] = {}
        self._map_process = SessionMapProcess()
        self._exporting = CommandProcess()

    def listing(self) -> dict[str, Any]:
        """Entries by kind, newest first: name, bytes, last change (Unix, s), whether it is in use, and
        whether a session can begin in it.
        """
        in_use = {path.resolve() for path in self._in_use()}
        found: dict[str, Any] = {"formats": {kind: list(formats) for kind, formats in FORMATS.items()}}
        for kind in self._folders:
            entries = [self._entry(path, in_use) for path in self._paths(kind)]
            entries.sort(key=lambda entry: (-entry["changed_s"], entry["name"]))
            found[kind] = entries[:MAX_LISTED]
        return found

    def rename(self, kind: Kind, name: str, to: str) -> str:
        """The new name; a session keeps its .mcap. Raises ResourceError."""
        with self._lock:
            path = self._own(kind, name)
            if kind == "session" and not to.endswith(".mcap"):
                to += ".mcap"
            if _NAME.fullmatch(to) is None:
                raise ResourceError(
                    f"{to!r} is no name for a {kind}: write letters, digits, _ . and -, at most 100, "
                    "a letter or digit first"
                )
            target = path.with_name(to)
            if target.exists():
                raise ResourceError(f"there is a {to} already")
            self._move(path, target)
            return to

    def delete(self, kind: Kind, name: str) -> str:
        """Move it to `.deleted`; returns the number that `undo` takes. Raises ResourceError."""
        with self._lock:
            path = self._own(kind, name)
            number = secrets.token_hex(8)
            aside = path.parent / DELETED / number
            try:
                aside.mkdir(parents=True)
            except OSError as error:
                raise ResourceError(f"{name} cannot be deleted: {words_of(error)}") from error
            self._move(path, aside / name)
            self._deleted[number] = (kind, name)
            return number

    def undo(self, number: str) -> str:
        """Bring back what was deleted; its name. Raises ResourceError."""
        with self._lock:
            if number not in self._deleted:
                raise ResourceError("that was brought back already, or deleted before the service started")
            kind, name = self._deleted[number]
            target = self._folders[kind] / name
            if target.exists():
                raise ResourceError(f"there is another {name} by now; rename it first")
            aside = self._folders[kind] / DELETED / number
            self._move(aside / name, target)
            del self._deleted[number]
            shutil.rmtree(aside, ignore_errors=True)
            return name

    def purge(self) -> None:
        """Erase what was deleted before this run, and exports that a killed run left."""
        for folder in set(self._folders.values()):
            shutil.rmtree(folder / DELETED, ignore_errors=True)
        shutil.rmtree(self._scratch, ignore_errors=True)

    def download(self, kind: Kind, name: str, to: str) -> Download:
        """File as it is stored, or exported by a process of its own. Raises ResourceError."""
        path = self._own(kind, name, is_changed=False)
        if to not in FORMATS[kind]:
            raise ResourceError(f"{to!r}: a {kind} is had as {', '.join(FORMATS[kind])}")
        if to == "mcap":
            return Download(path, name)
        with self._alone():
            return self._export(path, to)

    def look(self, name: str) -> dict[str, Any]:
        """Key frames and pairs of a stored map, which a session may go on extending. Raises ResourceError."""
        return self._map_process.ask("look", self._own("map", name, is_changed=False), {})

    def keyframe(self, name: str, request: dict[str, Any]) -> dict[str, Any]:
        """The points of a key frame of the viewed map. Raises ResourceError."""
        return self._map_process.ask("keyframe", self._own("map", name, is_changed=False), request)

    def close(self) -> None:
        self._exporting.close()
        self._map_process.close()

    @contextmanager
    def _alone(self) -> Iterator[None]:
        if not self._working.acquire(blocking=False):
            raise ResourceError("another export is being made; ask again when it is done")
        try:
            yield
        finally:
            self._working.release()

    def _export(self, path: Path, to: str) -> Download:
        scratch = self._scratch / secrets.token_hex(8)
        stem = path.name.removesuffix(".mcap")
        try:
            made = scratch / stem
            made.mkdir(parents=True)
            if to == "zip":
                shutil.copytree(path, made, dirs_exist_ok=True, symlinks=False)
            else:
                out = made / f"{stem}.{SUFFIXES.get(to, to)}"
                self._exporting.run("export", str(path), "--format", to, "--out", str(out))
            files = list(made.iterdir())
            if len(files) == 1 and files[0].is_file():
                return Download(files[0], files[0].name, scratch)
            archive = shutil.make_archive(str(scratch / stem), "zip", scratch, stem)
            return Download(Path(archive), f"{stem}.zip", scratch)
        except OSError as error:
            shutil.rmtree(scratch, ignore_errors=True)
            raise ResourceError(f"{path.name} cannot be exported: {words_of(error)}") from error
        except ResourceError:
            shutil.rmtree(scratch, ignore_errors=True)
            raise

    def _paths(self, kind: Kind) -> list[Path]:
        folder = self._folders[kind]
        if not folder.is_dir():
            return []
        if kind == "session":
            return [path for path in folder.glob("*.mcap*") if path.suffix in (".mcap", ".active")]
        return [path.parent for path in folder.glob("*/map.yaml") if path.parent.name != DELETED]

    def _entry(self, path: Path, in_use: Collection[Path]) -> dict[str, Any]:
        try:
            files = [path] if path.is_file() else [p for p in path.rglob("*") if not p.is_symlink()]
            size = sum(file.stat().st_size for file in files if file.is_file())
            changed_s = path.stat().st_mtime
        except OSError:  # gone meanwhile
            size, changed_s = 0, 0.0
        return {
            "name": path.name,
            "bytes": size,
            "changed_s": changed_s,
            "in_use": path.suffix == ".active" or path.resolve() in in_use,
            "has_graph": (path / GRAPH_FILE).is_file(),
        }

    def _own(self, kind: Kind, name: str, is_changed: bool = True) -> Path:
        """Only what the listing has: a name can lead nowhere else. Raises ResourceError."""
        for path in self._paths(kind):
            if path.name == name:
                if path.suffix == ".active":
                    raise ResourceError(f"{name} is being recorded; stop the recording first")
                if is_changed and path.resolve() in {used.resolve() for used in self._in_use()}:
                    raise ResourceError(f"{name} is in use by the service")
                return path
        raise ResourceError(f"there is no {kind} {name!r}")

    def _move(self, path: Path, target: Path) -> None:
        try:
            os.rename(path, target)
        except OSError as error:
            raise ResourceError(f"{path.name} cannot be moved to {target}: {words_of(error)}") from error
