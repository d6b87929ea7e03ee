"""A session that goes on in a stored map, and who changes it by hand, keep each other out."""

import fcntl
import threading
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import IO

from service.errors import StorageError, words_of


class InUse:
    """Holds a stored map from its making to `release`, or to the end of the process, however it ends.

    Raises StorageError where another one has it locked; `who` states what for.
    """

    def __init__(self, folder: Path, who: str) -> None:
        self._file: IO[str] | None = None
        try:
            file = (folder / ".in_use").open("a+", encoding="utf-8")
        except OSError as error:
            raise StorageError(f"{folder}: {words_of(error)}") from error
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            other = file.read().strip() or "another process"
            file.close()
            raise StorageError(
                f"{folder}: {other} uses this map and would write over the change; stop it first"
            ) from None
        self._file = file
        try:
            file.truncate(0)
            file.write(who)
            file.flush()
        except OSError as error:
            self.release()
            raise StorageError(f"{folder}: {words_of(error)}") from error

    def release(self) -> None:
        if self._file is not None:
            with suppress(OSError):  # of what a full disk has not taken; the lock is gone all the same
                self._file.close()
            self._file = None

    def __enter__(self) -> "InUse":
        return self

    def __exit__(self, *_: object) -> None:
        self.release()


class MapsInUse:
    """Stored maps that one session holds, each for as long as it is needed. From any thread."""

    def __init__(self, who: str) -> None:
        self._who = who
        self._lock = threading.Lock()  # of what follows
        self._in_use: dict[Path, InUse] = {}
        self._needed: Counter[Path] = Counter()  # how many times it is locked

    def hold(self, folder: Path) -> None:
        """To be let go once for each time. Raises StorageError where another one holds it."""
        with self._lock:
            if folder not in self._in_use:
                self._in_use[folder] = InUse(folder, self._who)
            self._needed[folder] += 1

    def let_go(self, folder: Path) -> None:
        """Others may change it when it was unlocked as often as it was locked."""
        with self._lock:
            if folder not in self._in_use:  # the session has ended
                return
            self._needed[folder] -= 1
            if self._needed[folder] == 0:
                self._in_use.pop(folder).release()

    def let_all_go(self) -> None:
        with self._lock:
            for in_use in self._in_use.values():
                in_use.release()
            self._in_use.clear()
            self._needed.clear()
