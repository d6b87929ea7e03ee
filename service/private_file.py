"""Files of secrets: read where no other user can, written completely or not at all."""

import os
import stat
from pathlib import Path
from shlex import quote

from service.errors import InputError, StorageError, words_of
from service.readable import open_file


def read_private(path: Path, what: str, most_bytes: int) -> bytes:
    """At most so many bytes. Raises StorageError where it cannot be read, or others may."""
    try:
        with open_file(path) as file:
            mode = stat.S_IMODE(os.fstat(file.fileno()).st_mode)
            content = file.read(most_bytes)
    except (OSError, InputError) as error:
        raise StorageError(f"{path}: {what} cannot be read: {words_of(error)}") from error
    if mode & 0o077:
        raise StorageError(f"{path}: others may read {what} (mode {mode:04o}); chmod 600 {quote(str(path))}")
    return content


def write_whole(path: Path, content: bytes, mode: int = 0o600, is_of_folder: bool = False) -> None:
    """Readable for others only where `mode` allows it. Raises OSError.

    is_of_folder   written by root it belongs to the owner of the folder: the service that reads it
    """
    beside = path.with_name(f".{path.name}.new")
    beside.unlink(missing_ok=True)
    with open(os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
        if is_of_folder and os.geteuid() == 0:
            owner = path.parent.stat()
            os.fchown(file.fileno(), owner.st_uid, owner.st_gid)
    beside.replace(path)
