"""Where compiled kernels are kept between starts: a folder named after everything that they depend on.

numba's own cache compares the file of a kernel only: it would keep one whose callee in another file changed.
"""

import atexit
import fcntl
import hashlib
import logging
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path

from service.interruption import before_ending

log = logging.getLogger(__name__)

KERNELS = Path(__file__).parents[1] / "kernels"
PREFIX = f"corridor-kernels-{sys.implementation.cache_tag}-"  # of the folders, then the key
CPUINFO = Path("/proc/cpuinfo")
KEY_LENGTH = 12  # hexadecimal digits
WARM_NAME = "warm"  # in a folder that has the kernels of all profiles


@cache
def cache_key() -> str:
    """Short hash of kernel sources, compiler, Python and processor."""
    sources = b"".join(path.read_bytes() for path in sorted(KERNELS.glob("*.py")))
    try:
        facts = CPUINFO.read_text().splitlines()
    except OSError:
        facts = []  # hidden, as by ProcSubset=pid of systemd; numba looks at the processor, too
    processor = next((line for line in facts if line.startswith("model name")), "")
    tools = f"numba {version('numba')} llvmlite {version('llvmlite')} Python {sys.version} {processor}"
    return hashlib.sha256(sources + tools.encode()).hexdigest()[:KEY_LENGTH]


def cache_places(environment: Mapping[str, str] = os.environ) -> list[Path]:
    """Parents of the folder, in the order in which they are tried."""
    if given := environment.get("NUMBA_CACHE_DIR"):
        return [Path(given)]
    home = environment.get("XDG_CACHE_HOME") or Path(environment.get("HOME") or "/") / ".cache"
    return [KERNELS / "__pycache__", Path(home) / "numba"]


def cache_folder(place: Path | None = None) -> Path:
    """The folder in `place`, or in the first place that can be written to."""
    return (place or _first_writable(tuple(cache_places()))) / f"{PREFIX}{cache_key()}"


def ensure_cache_dir() -> Path | None:
    """Delete this Python's folders of other sources; set NUMBA_CACHE_DIR to a temporary folder if no place is
    writable.

    Returns the temporary folder, or None. Call it before a kernel is compiled.
    """
    if _is_writable(place := cache_folder().parent):
        for folder in place.glob(PREFIX + KEY_LENGTH * "[0-9a-f]"):
            if folder != cache_folder(place):
                shutil.rmtree(folder, ignore_errors=True)
        return None
    # A new folder that only this user can write: cached kernels are code, and /tmp is shared.
    temporary = Path(tempfile.mkdtemp(prefix="corridor-kernels-"))
    forget = partial(shutil.rmtree, temporary, ignore_errors=True)
    atexit.register(forget)
    before_ending(forget)
    log.warning(
        "cannot write to %s; the kernels are compiled again at every start. Set NUMBA_CACHE_DIR to a folder "
        "that this user can write",
        " or ".join(map(str, cache_places())),
    )
    os.environ["NUMBA_CACHE_DIR"] = str(temporary)
    return temporary


def forget_kernels() -> int:
    """Delete the compiled kernels; number of files deleted."""
    files = len(list(cache_folder().glob("*.nb[ci]")))
    shutil.rmtree(cache_folder(), ignore_errors=True)
    return files


def mark_warm() -> None:
    """Note that the kernels of all profiles are compiled."""
    with suppress(OSError):  # then is_warm stays False
        (cache_folder() / WARM_NAME).touch()


def is_warm(place: Path | None = None) -> bool:
    """Whether nothing is left to compile for any profile. Call it after ensure_cache_dir."""
    return (cache_folder(place) / WARM_NAME).exists()


@contextmanager
def compiling_alone() -> Iterator[None]:
    """Let one process at a time compile, of those that share the folder, unless it is warm."""
    if is_warm() or not _is_writable(cache_folder()):
        yield
        return
    with _locked("lock"):
        yield


def saving_alone() -> AbstractContextManager[None]:
    """Let one process at a time save a kernel.

    numba reads the index of a kernel, numbers the new file after those in it, and writes both. Two processes
    that save different variants at the same time would use one number, and calls would get the wrong code.
    """
    return _locked("saving")


@contextmanager
def _locked(name: str) -> Iterator[None]:
    with (cache_folder() / name).open("w", encoding="ascii") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


@cache
def _first_writable(places: tuple[Path, ...]) -> Path:
    """The first of all where none is."""
    return next(filter(_is_writable, places), places[0])


def _is_writable(place: Path) -> bool:
    """Whether a file can be made there: access rights do not tell about a read-only mount."""
    try:
        place.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=place):
            return True
    except OSError:
        return False
