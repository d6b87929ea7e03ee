"""A folder that must take files for hours: whether it does shows at the start. What is on disk for good."""

import os
from pathlib import Path
from tempfile import TemporaryFile

from service.errors import StorageError


def make_writable(folder: Path) -> None:
    """Make it where it is missing, and see that a file can be made in it. That is tried, not asked: root has
    every right, yet a read-only mount refuses. Raises StorageError.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=folder):
            return
    except OSError as error:
        raise StorageError(f"cannot write to {folder}: {error.strerror}") from error


def sync(path: Path) -> None:
    """A file, or the names in a folder, survive a power cut when this has returned. Raises OSError."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
