"""Fetches the finished recordings of a vehicle, oldest first; what is there already is not fetched again."""

import fcntl
import hashlib
import json
import logging
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import zenoh

from service.errors import InputError, StorageError
from service.fleet.queries import ask, ask_json
from service.sinks.fleet_files import JOURNAL, RECORDINGS
from service.writable import sync

log = logging.getLogger(__name__)

JOURNAL_FILE = "journal.jsonl"
PART = ".part"  # ends the name of what is not complete yet
TRIES = 6
PAUSE_S = 1.0  # before the second try of a part; doubled for each further one
Progress = Callable[[int, int], None]  # bytes that are here, bytes in all


@dataclass(frozen=True, slots=True)
class Pulled:
    """Names of recordings."""

    fetched: tuple[str, ...]
    there: tuple[str, ...]  # before
    bytes: int  # that were fetched
    journal_lines: int  # that were


def pull(
    session: zenoh.Session,
    vehicle: str,
    out: Path,
    limit_bytes_per_s: float | None = None,
    progress: Progress = lambda done, total: None,
    pause_s: float = PAUSE_S,
) -> Pulled:
    """Into out/<vehicle>/. One part is requested at a time, behind all else on the vehicle's link. Another
    recording that is there by the same name is kept under a further one.

    Raises RefusedError; StorageError where the vehicle does not answer any more, or another call writes
    there, OSError where the disk refuses: what has come stays, and the next call goes on there; InputError
    where a file is not what the vehicle has.
    """
    folder = out / vehicle
    listed = {str(one["name"]): int(one["bytes"]) for one in ask_json(session, vehicle, RECORDINGS)}
    if unsafe := [name for name in listed if Path(name).name != name or not name.endswith(".mcap")]:
        raise InputError(f"{vehicle}: {unsafe[0]!r} is no name of a recording")
    folder.mkdir(parents=True, exist_ok=True)
    with _alone_in(folder):
        return _fetch_missing(session, vehicle, folder, listed, limit_bytes_per_s, progress, pause_s)


@contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise StorageError(f"another pull writes to {folder}; wait until it has ended") from None
        yield
    finally:
        os.close(descriptor)


def _fetch_missing(
    session: zenoh.Session,
    vehicle: str,
    folder: Path,
    listed: Mapping[str, int],
    limit_bytes_per_s: float | None,
    progress: Progress,
    pause_s: float,
) -> Pulled:
    """listed: bytes of the vehicle's recordings. Raises as pull."""
    there = [name for name, size in listed.items() if _size(folder / name) == size]
    missing = {name: size for name, size in listed.items() if name not in there}
    lines = _pull_journal(session, vehicle, folder / JOURNAL_FILE, pause_s)
    total, done, fetched_bytes = sum(missing.values()), 0, 0
    began_s = time.monotonic()
    for name, size in missing.items():
        part = folder / f"{name}{PART}"
        had = min(_size(part) or 0, size)
        with part.open("r+b" if part.exists() else "w+b") as file:
            file.truncate(had)
            file.seek(had)
            while (at := file.tell()) < size:
                content = _requested_again(session, vehicle, f"{RECORDINGS}/{name}?offset={at}", pause_s)
                if not content:
                    raise InputError(f"{vehicle}: {name} ends at {at} bytes, of {size}; was it replaced?")
                file.write(content)
                fetched_bytes += len(content)
                progress(done + file.tell(), total)
                if limit_bytes_per_s is not None:
                    time.sleep(max(fetched_bytes / limit_bytes_per_s - (time.monotonic() - began_s), 0.0))
        _check(part, _requested_again(session, vehicle, f"{RECORDINGS}/{name}?sha256=1", pause_s).decode())
        _keep_other(folder / name, size)
        os.replace(part, folder / name)
        sync(folder)
        done += size
        log.info("%s: %s, %.1f MB", vehicle, name, size / 1e6)
    return Pulled(tuple(missing), tuple(there), fetched_bytes, lines)


def _pull_journal(session: zenoh.Session, vehicle: str, path: Path, pause_s: float) -> int:
    """Append what the vehicle noted since the last line, page by page; how many lines."""
    count = 0
    with path.open("a+b") as file:
        file.truncate(_complete_lines(path))
        after_ns = _last_unix_ns(path)
        while page := _requested_again(session, vehicle, f"{JOURNAL}?after={after_ns}", pause_s):
            file.write(page)
            file.flush()
            os.fsync(file.fileno())
            after_ns = _last_unix_ns(path)
            count += page.count(b"\n")
    return count


def _tail(path: Path) -> bytes:
    """Its end; a line is shorter."""
    with path.open("rb") as file:
        file.seek(max(path.stat().st_size - (1 << 16), 0))
        return file.read()


def _complete_lines(path: Path) -> int:
    """Size without a last line that was cut off."""
    tail = _tail(path)
    return path.stat().st_size - len(tail) + tail.rfind(b"\n") + 1


def _last_unix_ns(path: Path) -> int:
    """Raises InputError."""
    lines = _tail(path).splitlines()
    try:
        return int(json.loads(lines[-1])["unix_ns"]) if lines else 0
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: its last line is none of a journal; move it away") from error


def _requested_again(session: zenoh.Session, vehicle: str, channel: str, pause_s: float) -> bytes:
    """The link may be lost meanwhile: Zenoh brings it back."""
    for number in range(TRIES - 1):
        try:
            return ask(session, vehicle, channel)
        except StorageError:
            time.sleep(pause_s * 2**number)
    return ask(session, vehicle, channel)


def _check(part: Path, expected: str) -> None:
    """On the disk, and what the vehicle has; else it is removed."""
    sync(part)
    with part.open("rb") as file:
        found = hashlib.file_digest(file, "sha256").hexdigest()
    if found != expected:
        part.unlink()
        raise InputError(
            f"{part}: SHA-256 {found}, the vehicle's file has {expected}; removed, fetch it again"
        )


def _keep_other(path: Path, size: int) -> None:
    """Another recording by that name stays: of a vehicle whose clock begins anew at each boot, say."""
    if _size(path) not in (None, size):
        kept = path.with_name(f"{path.stem}_of_{path.stat().st_mtime_ns}{path.suffix}")
        path.rename(kept)
        log.warning("%s was here, of another size than the vehicle's: it is kept as %s", path, kept.name)


def _size(path: Path) -> int | None:
    return path.stat().st_size if path.is_file() else None
