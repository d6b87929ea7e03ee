"""What an engine runs, and what comes of it."""

import hashlib
import logging
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Protocol

import service
from service.compile.cache import ensure_cache_dir
from service.errors import CorridorError
from service.version import VERSION

LOGGER = logging.getLogger("service")


class AnyTask(Protocol):
    """Can be pickled; its paths mean the same in another process or, on a shared disk, on another node."""

    @property
    def name(self) -> str:
        """Name of the session, for the report of a failure."""

    @property
    def program(self) -> str:
        """Digest of the sources of the client; "": any."""

    def work(self) -> "Done":
        """Do it. Raises CorridorError."""


@dataclass(frozen=True, slots=True)
class Done:
    """outcome    a summary, or why there is none
    manifest   what the result was made of; {} where there is none
    was_done   by an earlier run
    """

    outcome: dict[str, Any] | CorridorError
    manifest: dict[str, Any]
    was_done: bool = False


@cache
def program_digest() -> str:
    """SHA-256 of the sources that make a result, by which workers of another version are refused."""
    root = Path(service.__file__).parents[1]
    digest = hashlib.sha256()
    for path in sorted(path for package in ("drivers", "service") for path in (root / package).rglob("*.py")):
        digest.update(f"{path.relative_to(root)}\n".encode() + path.read_bytes())
    return digest.hexdigest()


def run(task: AnyTask) -> Done:
    """Never raises: a fault of the program, too, is the outcome of its task alone."""
    ensure_cache_dir()
    if task.program not in ("", program_digest()):
        words = f"the worker has other sources of corridor ({VERSION}) than the command"
        return Done(CorridorError(f"{task.name}: {words}; install the same wheel on every node"), {})
    try:
        return task.work()
    except CorridorError as error:
        return Done(error, {})
    except Exception:
        words = traceback.format_exc()
        return Done(CorridorError(f"{task.name}: this is a fault of the program\n{words}"), {})


@contextmanager
def logged(write: Callable[[str], object]) -> Iterator[None]:
    """Inside, what the service logs in this process goes to `write`, a line each."""
    handler = _Lines(write)
    before = LOGGER.level
    LOGGER.addHandler(handler)
    LOGGER.setLevel(logging.INFO)
    try:
        yield
    finally:
        LOGGER.setLevel(before)
        LOGGER.removeHandler(handler)


class _Lines(logging.Handler):
    def __init__(self, write: Callable[[str], object]) -> None:
        super().__init__(logging.INFO)
        self._write = write
        self.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))

    def emit(self, record: logging.LogRecord) -> None:
        self._write(self.format(record))
