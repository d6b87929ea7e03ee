"""Files and folders that are handed in, before they are read.

A search in a folder without rights finds nothing, and not why. Reading a pipe or a device may never end.
"""

import os
import stat
from io import BufferedReader
from pathlib import Path

from service.archive import is_remote, refuse_unreachable
from service.errors import InputError
from service.limits import MAX_TEXT_BYTES, check

_KINDS = {stat.S_IFIFO: "pipe", stat.S_IFSOCK: "socket", stat.S_IFCHR: "device", stat.S_IFBLK: "device"}


def refuse_unreadable(path: Path) -> None:
    """Raises InputError where `path` is not there, is neither a regular file nor a folder, or is a folder
    that may not be looked into.
    """
    if is_remote(path):
        refuse_unreachable(path)
        return
    try:
        _refuse_special(path)
        if path.is_dir():
            os.listdir(path)
            (path / "any").exists()  # a folder that may be listed and not entered
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file or folder") from error
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from error
    except ValueError as error:  # a NUL in it
        raise InputError(f"{str(path)!r}: {error}") from error


def open_file(path: Path) -> BufferedReader:
    """A regular file, to be read; never waits. Raises InputError for what is none, OSError as the system."""
    _refuse_special(path)
    return open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK))


def read_text(path: Path, encoding: str = "utf-8", limit: int = MAX_TEXT_BYTES) -> str:
    """The whole of it. Raises as open_file, TooLargeError beyond the limit of bytes, UnicodeDecodeError."""
    with open_file(path) as file:
        check(os.fstat(file.fileno()).st_size, limit, str(path))
        return file.read().decode(encoding)


def _refuse_special(path: Path) -> None:
    kind = _KINDS.get(stat.S_IFMT(path.stat().st_mode))
    if kind is not None:
        raise InputError(f"{path}: a {kind}; expected a regular file, to which it can be copied")
