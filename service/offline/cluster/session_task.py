"""A session as a task: it is replayed to its folder, unless that holds the same result already."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from service.archive import fingerprint
from service.errors import CorridorError, InputError, StorageError, words_of
from service.offline.cluster.tasks import Done, program_digest
from service.offline.past.result import DONE_FILE, SUMMARY_FILE
from service.offline.replay.replay import replay_to
from service.offline.replay.result import Extra
from service.offline.replay.setup import ReplayOptions
from service.readable import refuse_unreadable
from service.version import VERSION


@dataclass(frozen=True, slots=True)
class Task:
    """program    digest of the sources of the client
    is_again   do it although it is done
    """

    session: tuple[Path, ...]
    options: ReplayOptions
    folder: Path
    extras: tuple[Extra, ...] = ()
    program: str = ""
    is_again: bool = False

    @property
    def name(self) -> str:
        return str(self.session[0])

    def work(self) -> Done:
        """Raises CorridorError."""
        manifest = _manifest(self)
        try:
            if not self.is_again and (summary := _summary_of(self.folder, manifest)) is not None:
                return Done(summary, manifest, was_done=True)
            summary = replay_to(self.session, self.options, self.folder, self.extras)
            (self.folder / DONE_FILE).write_text(json.dumps(manifest, indent=1) + "\n", encoding="utf-8")
        except CorridorError:
            raise
        except OSError as error:
            raise StorageError(f"cannot write to {self.folder}: {words_of(error)}") from error
        return Done(summary, manifest)


def _manifest(task: Task) -> dict[str, Any]:
    """All that the bytes of the result depend on. Raises InputError."""
    options = asdict(replace(task.options, config=None, map=None))
    of_files = {"config": task.options.config, "map": task.options.map}
    return {
        "corridor": VERSION,
        "program": program_digest(),
        "input": _inputs(task.session),
        "options": json.loads(json.dumps(options, default=str)),
        "files": {name: _fingerprint(path) for name, path in of_files.items() if path is not None},
        "extras": sorted(task.extras),
    }


def _inputs(session: Sequence[Path]) -> dict[str, str]:
    return {path.name: _fingerprint(path) for path in session}


def _fingerprint(path: Path) -> str:
    refuse_unreadable(path)
    try:
        return fingerprint(path)
    except OSError as error:
        raise InputError(f"{path}: {words_of(error)}") from error


def _summary_of(folder: Path, manifest: dict[str, Any]) -> dict[str, Any] | None:
    """Summary of the existing result, where its manifest is the same; else None."""
    try:
        if json.loads((folder / DONE_FILE).read_text(encoding="utf-8")) != manifest:
            return None
        summary = json.loads((folder / SUMMARY_FILE).read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return None
    return summary if isinstance(summary, dict) else None


def is_result_of(folder: Path, session: Sequence[Path]) -> bool:
    """Whether a folder has the complete result of these files, by whichever version and config. Raises
    InputError where they cannot be read.
    """
    try:
        manifest = json.loads((folder / DONE_FILE).read_text(encoding="utf-8"))
        return bool(manifest["input"] == _inputs(session))
    except (OSError, ValueError, KeyError, TypeError):
        return False


def new_tasks(
    sessions: Sequence[Sequence[Path]],
    options: ReplayOptions,
    folders: Sequence[Path],
    extras: Sequence[Extra] = (),
    is_again: bool = False,
) -> list[Task]:
    """With paths that mean the same in another process or, on a shared disk, on another node."""
    options = replace(options, config=_absolute(options.config), map=_absolute(options.map))
    return [
        Task(
            tuple(path.absolute() for path in session),
            options,
            folder.absolute(),
            tuple(extras),
            program_digest(),
            is_again,
        )
        for session, folder in zip(sessions, folders, strict=True)
    ]


def _absolute(path: Path | None) -> Path | None:
    return None if path is None else path.absolute()
