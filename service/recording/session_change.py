"""What a recorder of sessions answers to a request to begin or to end one."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class SessionChange:
    """What became of the request to begin or to end a session."""

    changed: bool  # False: it was so already
    files: list[Path]  # the one being written; of an ended session all, complete, oldest first
    error: str  # why the disk does not do it, else ""


SessionHeard = Callable[[SessionChange], None]
