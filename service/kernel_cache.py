"""Where the compiled kernels are kept between starts.

numba wants a writable place and raises at import where it finds none: a read-only install under
ProtectSystem=strict, a user without a home. It looks at NUMBA_CACHE_DIR, then beside the source, then in the
user's cache folder; so does this, before numba is imported.
"""

import atexit
import logging
import os
import shutil
import tempfile
from pathlib import Path

log = logging.getLogger(__name__)

KERNELS = Path(__file__).parent / "kernels"


def ensure_cache_dir() -> Path | None:
    """Make sure that numba finds a place, by setting NUMBA_CACHE_DIR to a temporary one if it must be.

    The temporary place where that was needed, else None. Call it before anything imports numba.
    """
    given = os.environ.get("NUMBA_CACHE_DIR")
    home_cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "numba"
    places = [Path(given)] if given else [KERNELS / "__pycache__", home_cache]
    if any(_is_writable(place) for place in places):
        return None
    # A fresh folder that only we can write: cached kernels are code, and /tmp belongs to everybody.
    temporary = Path(tempfile.mkdtemp(prefix="corridor-kernels-"))
    atexit.register(shutil.rmtree, temporary, ignore_errors=True)
    os.environ["NUMBA_CACHE_DIR"] = str(temporary)
    log.warning(
        "cannot write to %s; the kernels are compiled anew at every start. Set NUMBA_CACHE_DIR to a folder "
        "that this user can write",
        " or ".join(map(str, places)),
    )
    return temporary


def _is_writable(place: Path) -> bool:
    """Tried rather than asked: root has every right, and still cannot write to a read-only mount."""
    try:
        place.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=place):
            return True
    except OSError:
        return False
