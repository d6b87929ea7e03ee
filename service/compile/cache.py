"""Where the compiled kernels are kept between starts.

numba wants a writable place and raises at import where it finds none: a read-only install under
ProtectSystem=strict, a user without a home. It looks at NUMBA_CACHE_DIR, then beside the source, then in the
user's cache folder; so does this, before numba is imported.
"""

import atexit
import fcntl
import hashlib
import logging
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from importlib.metadata import version
from pathlib import Path

from service.interruption import before_ending

log = logging.getLogger(__name__)

KERNELS = Path(__file__).parents[1] / "kernels"
DIGEST_NAME = "corridor-kernels.sha256"
LOCK_NAME = "corridor-kernels.lock"
WARM_NAME = "corridor-kernels.warm"  # written when the kernels of all profiles are in the cache


def ensure_cache_dir() -> Path | None:
    """Make sure that numba finds a place, by setting NUMBA_CACHE_DIR to a temporary one if it must be.

    The temporary place where that was needed, else None. Call it before anything imports numba.
    """
    if _is_writable(place := cache_place()):
        forget_old_kernels(place)
        return None
    # A fresh folder that only we can write: cached kernels are code, and /tmp belongs to everybody.
    temporary = Path(tempfile.mkdtemp(prefix="corridor-kernels-"))
    forget = partial(shutil.rmtree, temporary, ignore_errors=True)
    atexit.register(forget)
    before_ending(forget)
    os.environ["NUMBA_CACHE_DIR"] = str(temporary)
    log.warning(
        "cannot write to %s; the kernels are compiled again at every start. Set NUMBA_CACHE_DIR to a folder "
        "that this user can write",
        " or ".join(map(str, _places())),
    )
    return temporary


def cache_place() -> Path:
    """Where numba keeps the kernels: the first of its places that can be written to."""
    places = _places()
    return next(filter(_is_writable, places), places[0])


def forget_old_kernels(place: Path) -> None:
    """Drop what was compiled from other sources than those that stand here now.

    numba looks only at the file that a kernel stands in: after `git pull` one that calls a changed kernel of
    another file would go on with the old one.
    """
    try:
        if not _is_fresh(place):
            _forget(place)
            (place / DIGEST_NAME).write_text(_digest(), encoding="ascii")
    except OSError as error:
        log.warning(
            "%s: kernels compiled from older sources may be in use (%s); delete the folder", place, error
        )


def forget_kernels() -> int:
    """Delete every compiled kernel that a start would read; how many there were."""
    return sum(map(_forget, dict.fromkeys([_places()[0], _home_cache()])))


def mark_warm() -> None:
    """Note that the kernels of all profiles are in the cache, as they are compiled here and now."""
    with suppress(OSError):  # then no one may rely on it
        (cache_place() / WARM_NAME).write_text(_compiled_for(), encoding="utf-8")


def is_warm(place: Path | None = None) -> bool:
    """Whether nothing is left to compile, whatever profile maps. Call it after ensure_cache_dir.

    place   where the kernels are kept; None: where this process keeps them
    """
    return _reads((place or cache_place()) / WARM_NAME, _compiled_for())


@contextmanager
def compiling_alone() -> Iterator[None]:
    """One process at a time of those that share the cache, so that each kernel is compiled once; all at once
    where nothing is left to compile.
    """
    place = cache_place()
    if is_warm(place) or not _is_writable(place):
        yield
        return
    with (place / LOCK_NAME).open("w", encoding="ascii") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def cache_key() -> str:
    """Short hash of sources, their place, compiler and processor: kernels of another are not used."""
    return hashlib.sha256(_compiled_for().encode()).hexdigest()[:12]


def kernels_in(place: Path) -> int:
    """How many kernels of the present sources are kept there."""
    return sum(path.suffix == ".nbi" for path in _compiled_in(place)) if _is_fresh(place) else 0


def _places() -> list[Path]:
    """Where numba looks for a place, in its order."""
    given = os.environ.get("NUMBA_CACHE_DIR")
    return [Path(given)] if given else [KERNELS / "__pycache__", _home_cache()]


def _home_cache() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "numba"


def _is_writable(place: Path) -> bool:
    """Tried rather than asked: root has every right, and still cannot write to a read-only mount."""
    try:
        place.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=place):
            return True
    except OSError:
        return False


def _compiled_for() -> str:
    """Sources and where they lie, compiler and processor; numba reads no kernel of another."""
    cpuinfo = Path("/proc/cpuinfo").read_text().splitlines()
    processor = next((line for line in cpuinfo if line.startswith("model name")), "")
    packages = " ".join(f"{name} {version(name)}" for name in ("numba", "llvmlite"))
    return f"{KERNELS}\n{_digest()}\n{packages}, Python {sys.version}\n{processor}\n"


def _digest() -> str:
    return hashlib.sha256(b"".join(path.read_bytes() for path in sorted(KERNELS.glob("*.py")))).hexdigest()


def _is_fresh(place: Path) -> bool:
    return _reads(place / DIGEST_NAME, _digest())


def _reads(path: Path, text: str) -> bool:
    try:
        return path.read_text(encoding="utf-8") == text
    except OSError:
        return False


def _forget(place: Path) -> int:
    """How many files of numba there were."""
    (place / WARM_NAME).unlink(missing_ok=True)
    compiled = _compiled_in(place)
    for path in compiled:
        path.unlink(missing_ok=True)
    return len(compiled)


def _compiled_in(place: Path) -> list[Path]:
    """numba's files lie beside the sources, or in a folder that has the name of theirs and a hash."""
    return [path for p in ("*.nb[ci]", f"{KERNELS.name}_*/*.nb[ci]") for path in place.glob(p)]
