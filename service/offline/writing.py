"""Files that a command writes: a fault of their place shows before the work, and none is left half done."""

import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from service.archive import is_remote, refuse_missing_bucket
from service.errors import StorageError, words_of


def refuse_unwritable_folder(folder: Path) -> None:
    """Raises StorageError where `folder` cannot be made, or no file in it. Nothing is made here.

    Of a URL only the bucket is looked for, which s3fs would make.
    """
    if is_remote(folder):
        refuse_missing_bucket(folder)
        return
    nearest = next(path for path in (folder, *folder.absolute().parents) if os.path.lexists(path))
    if not nearest.is_dir():
        raise StorageError(f"cannot write to {folder}: {nearest} is no folder")
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise StorageError(f"cannot write to {folder}: no right to write in {nearest}")


def refuse_unwritable_file(path: Path) -> None:
    """The same for a file, whose folder is made where it is missing."""
    if path.is_dir():
        raise StorageError(f"cannot write {path}: {os.strerror(errno.EISDIR)}")
    refuse_unwritable_folder(path.parent)


@contextmanager
def complete_files(out: Path) -> Iterator[Path]:
    """A path of the same name in a folder of its own: what is written there and beside it takes its place at
    the end, each file complete, at `out` and beside it. If the work is interrupted, all stays as it was.

    The folder of `out` is made where it is missing. A link is followed and its file written directly. A
    device, a pipe or /dev/stdout gets the file of its name, and nothing is put beside it. Raises StorageError
    for each OSError, also inside.
    """
    try:
        if _is_stream(out):
            with TemporaryDirectory(prefix="corridor-") as folder:
                yield (path := Path(folder) / out.name)
                with path.open("rb") as file, out.open("wb") as stream:
                    shutil.copyfileobj(file, stream)
            return
        if out.is_symlink():
            yield out
            return
        out.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix=".corridor-", dir=out.parent) as folder:
            yield Path(folder) / out.name
            for made in sorted(Path(folder).iterdir()):
                made.replace(out.with_name(made.name))
    except OSError as error:
        raise StorageError(f"cannot write {out}: {words_of(error)}") from error


def _is_stream(out: Path) -> bool:
    """Also one of the links of /dev and /proc, such as /dev/stdout, to whatever the shell has opened."""
    if out.is_symlink():
        return out.absolute().parts[1] in ("dev", "proc")
    return out.exists() and not out.is_file()
