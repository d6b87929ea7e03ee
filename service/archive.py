"""Paths in object stores and on web servers (extra archive): any URL that fsspec reads.

A URL becomes a UPath, which has the methods of pathlib.Path that reading and listing need; whoever takes a
Path here takes one of these, too. What only the local disk can do is done in a folder of it.
"""

import hashlib
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, BinaryIO, cast
from urllib.parse import unquote, urlsplit

from service.errors import InputError, StorageError, UsageError, words_of
from service.extras import optional

READ_BYTES = 4 << 20  # of a file elsewhere, at a time: an MCAP is read chunk by chunk, about 1 MB each
# What stores say of the content of a file, the strongest first
CHECKSUMS = ("sha256", "md5Hash", "md5", "ETag", "etag", "Content-MD5", "Digest", "checksum")


def path_or_url(text: str) -> Path:
    """A local path, or what behaves like one for a URL. `file://` is a local path.

    Raises UsageError for a scheme that is not known, CorridorError where the extra is not installed.
    """
    if "://" not in text:
        return Path(text)
    parts = urlsplit(text)
    if parts.scheme == "file":
        return Path(unquote(parts.path))
    upath = optional("upath", "archive", text)
    if parts.scheme == "s3":
        optional("s3fs", "archive", text)
    try:
        path = upath.UPath(text)
        path.fs  # noqa: B018  # only now the scheme is looked up
    except Exception as error:  # each store raises its own
        raise UsageError(f"{text} cannot be opened: {words_of(error)}") from error
    return cast(Path, path)


def is_remote(path: Path) -> bool:
    """Whether it is a URL."""
    return not isinstance(path, Path)


def open_binary(path: Path) -> BinaryIO:
    """To read and seek in; of a file elsewhere only what is read is fetched, READ_BYTES at a time.

    Raises OSError; InputError where a web server can only send the whole file.
    """
    if not is_remote(path):
        return path.open("rb")
    file: Any = cast(Any, path).open("rb", block_size=READ_BYTES, cache_type="readahead")
    try:
        if str(path).startswith("http") and file.size:  # only a read shows whether such a server can
            file.seek(-1, 2)
            file.read(1)
            file.seek(0)
    except ValueError as error:
        raise InputError(f"{path}: the server sends no parts of files (Range); copy it here") from error
    return cast(BinaryIO, file)


def refuse_unreachable(url: Path) -> None:
    """Raises InputError where a store has no such file or folder, or does not answer."""
    try:
        if not url.exists():
            raise InputError(f"{url}: no such file or folder")
    except InputError:
        raise
    except Exception as error:  # each store raises its own
        raise InputError(f"{url} cannot be read: {words_of(error)}") from error


def refuse_missing_bucket(url: Path) -> None:
    """Raises StorageError where the bucket of an S3 URL is not there, or the store does not answer."""
    store = cast(Any, url)
    if store.protocol != "s3":
        return
    try:
        store.fs.info(url.drive)
    except FileNotFoundError as error:
        raise StorageError(f"cannot write to {url}: there is no bucket {url.drive}; make it first") from error
    except PermissionError:
        return  # who may write below a prefix alone may not ask for the bucket
    except Exception as error:  # each store raises its own
        raise StorageError(f"cannot write to {url}: {words_of(error)}") from error


def fingerprint(path: Path) -> str:
    """Of the content of a file or of all files below a folder: SHA-256; of a file elsewhere what its store
    says of the content, and SHA-256 only where that is nothing.

    Raises OSError.
    """
    if path.is_dir():
        files = sorted((one for one in path.rglob("*") if one.is_file()), key=str)
        lines = [f"{str(one)[len(str(path)) :]} {fingerprint(one)}\n" for one in files]
        return f"files {hashlib.sha256(''.join(lines).encode()).hexdigest()}"
    if is_remote(path):
        about = cast(Any, path).fs.info(cast(Any, path).path)
        checksum = next((f"{name} {about[name]}" for name in CHECKSUMS if about.get(name)), None)
        if checksum is not None:
            return f"{checksum} size {about.get('size')}"
    with open_binary(path) as file:
        return f"sha256 {hashlib.file_digest(cast(Any, file), 'sha256').hexdigest()}"


def copy_here(path: Path, target: Path) -> None:
    """A file elsewhere to the local disk, for readers that need it there. Raises OSError."""
    with open_binary(path) as source, target.open("xb") as file:
        shutil.copyfileobj(source, file, READ_BYTES)


@contextmanager
def written_to(out: Path, remains_in: Callable[[Path], Iterable[Path]]) -> Iterator[Path]:
    """A local folder of the name of `out` to write in. Its files are moved to the folder or the URL `out` at
    the end, where those of `remains_in` are removed. Where the work fails, nothing is moved or removed.

    Raises StorageError, also for each OSError inside.
    """
    if not is_remote(out):
        with _beside(out) as folder:
            yield folder
            for path in remains_in(out):
                shutil.rmtree(path) if path.is_dir() else path.unlink()
            for made in sorted(folder.iterdir()):
                made.replace(out / made.name)
        return
    with TemporaryDirectory(prefix="corridor-") as parent:
        folder = Path(parent) / out.name
        folder.mkdir(exist_ok=True)
        yield folder
        try:
            store = cast(Any, out)
            for path in remains_in(out):
                store.fs.rm(cast(Any, path).path, recursive=True)
            store.fs.put(f"{folder}/", f"{store.path}/", recursive=True)
        except Exception as error:  # each store raises its own
            raise StorageError(f"cannot write to {out}: {words_of(error)}") from error


@contextmanager
def _beside(out: Path) -> Iterator[Path]:
    """A folder on the disk of the folder `out`, which is made, and removed again where the work fails."""
    is_new = not out.exists()
    try:
        out.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix=".corridor-", dir=out) as parent:
            folder = Path(parent) / out.resolve().name
            folder.mkdir(exist_ok=True)
            yield folder
    except BaseException as error:
        if is_new:
            with suppress(OSError):  # it is not empty
                out.rmdir()
        if isinstance(error, OSError):
            raise StorageError(f"cannot write to {out}: {words_of(error)}") from error
        raise
