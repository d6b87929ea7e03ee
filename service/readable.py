"""Files and folders that are handed in: a search in a folder without rights finds nothing, and not why."""

import os
from pathlib import Path

from service.archive import is_remote, refuse_unreachable
from service.errors import InputError


def refuse_unreadable(path: Path) -> None:
    """Raises InputError where `path` is not there, or is a folder that may not be looked into."""
    if is_remote(path):
        refuse_unreachable(path)
        return
    try:
        path.stat()
        if path.is_dir():
            os.listdir(path)
            (path / "any").exists()  # a folder that may be listed and not entered
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file or folder") from error
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from error
    except ValueError as error:  # a NUL in it
        raise InputError(f"{str(path)!r}: {error}") from error
