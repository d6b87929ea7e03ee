"""Answer of a recorder to a request to begin or to end a session."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class SessionChange:
    """Result of a request to begin or to end a session."""

    changed: bool  # False: it was so already
    files: list[Path]  # the one being written; of an ended session all, complete, oldest first
    error: str  # why the disk does not do it, else ""


SessionHeard = Callable[[SessionChange], None]
