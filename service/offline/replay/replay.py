"""Recordings through the same mapper as the live service: same input, same output, bit for bit."""

import itertools
import logging
import re
from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from shlex import quote
from tempfile import TemporaryDirectory
from typing import Any

from service.archive import is_remote, refuse_unreachable
from service.compile.warm_up import KernelProgress, warm_up_in_turn
from service.encoding import warm_up as warm_up_encoding
from service.errors import CorridorError, StorageError, UsageError, words_of
from service.mapstore.begin_in import begin_in
from service.offline.past.result import DONE_FILE, MAP_FOLDER, UNEDITED
from service.offline.replay.figures import Warned, doubts
from service.offline.replay.pace import Watch
from service.offline.replay.raw import FROM_RAW, remake_frames
from service.offline.replay.result import Extra, Replay, write_replay
from service.offline.replay.run import MAPPING, Progress, ReplayRun
from service.offline.replay.setup import ReplayOptions, choice_of, set_up
from service.offline.writing import refuse_unwritable_folder
from service.readable import refuse_unreadable
from service.recording.mcap_source import open_session
from service.recording.opening import is_recording, name_of, recordings_in

log = logging.getLogger(__name__)

REMAKING, COMPILING = "decoding", "compiling kernels"  # phases, before those of a ReplayRun
DEFAULT_OUT = Path("out")
_SESSION_FILE = re.compile(r"(.+_\d{8}T\d{6}Z)_\d{4}\.mcap")


def group_sessions(paths: Sequence[Path]) -> list[list[Path]]:
    """Files and folders that belong to one drive, oldest first: a session or a bag may be cut into several.

    A folder that is no ROS 2 bag stands for the recordings in it. Raises InputError for a folder that may not
    be read, or without recordings.
    """
    files: list[Path] = []
    for path in paths:
        if is_remote(path):
            refuse_unreachable(path)
        if not path.is_dir() or is_recording(path):
            files.append(path)
            continue
        refuse_unreadable(path)
        files += recordings_in(path)
    drives: dict[tuple[Path, str], list[Path]] = {}
    for file in dict.fromkeys(files):
        drives.setdefault((file.parent, _drive_of(file)), []).append(file)
    return [sorted(parts) for parts in drives.values()]


def _drive_of(file: Path) -> str:
    """Common name of the files of one drive, else the full name; `ros2 bag record` numbers the files in a
    folder of their name, which has no metadata.yaml where it was killed.
    """
    if part_of := _SESSION_FILE.fullmatch(file.name):
        return part_of[1]
    name, _, number = name_of(file).rpartition("_")
    return name if number.isdecimal() and name == file.parent.resolve().name else file.name


def result_folders(
    sessions: Sequence[Sequence[Path]], out: Path | None, is_batch: bool = False
) -> list[Path]:
    """Folder of each session's result, all different: of one `out` itself, of several and of a batch folders
    below it, named after them; without `out` each to out/replay_<name>.
    """
    if out is not None and len(sessions) == 1 and not is_batch:
        return [out]
    folders: list[Path] = []
    for session in sessions:
        name = session_name(session)
        folder = out / name if out is not None else DEFAULT_OUT / f"replay_{name}"
        like = (folder.with_name(f"{folder.name}_{number}") for number in itertools.count(2))
        folders.append(folder if folder not in folders else next(one for one in like if one not in folders))
    return folders


def session_name(session: Sequence[Path]) -> str:
    """Name of the session that files of one drive make."""
    part_of = _SESSION_FILE.fullmatch(session[0].name)
    return part_of[1] if part_of else name_of(session[0])


Outcome = dict[str, Any] | CorridorError  # of one session: its summary, or why there is none


def replay_all(
    sessions: Sequence[Sequence[Path]],
    options: ReplayOptions,
    folders: Sequence[Path],
    progress: Progress,
    watch: Watch | None = None,
    extras: Collection[Extra] = (),
) -> list[Outcome]:
    """Replay each session and write the files of `write_replay` to its folder; their outcomes, in order. One
    that fails keeps none of the others back. Several at a time: see service.offline.cluster.
    """
    outcomes: list[Outcome] = []
    for k, (session, folder) in enumerate(zip(sessions, folders, strict=True)):
        try:
            shown = _part_of(progress, k, len(sessions))
            outcomes.append(replay_to(session, options, folder, extras, shown, watch))
        except CorridorError as error:
            outcomes.append(error)
    return outcomes


def replay(
    paths: Sequence[Path],
    options: ReplayOptions,
    progress: Progress = lambda share, phase: None,
    watch: Watch | None = None,
) -> Replay:
    """Map one recording. Raises InputError, ConfigError where the config cannot be used, and StorageError.

    `warnings` of the summary has all that was logged as one meanwhile, and why scans were not `ok`.
    """
    with Warned() as warned:
        mapped = _replay_from_raw if options.from_raw else _replay
        done = mapped(paths, options, progress, watch or Watch(options.rate))
    done.summary["warnings"] = [*warned.lines, *doubts(done.summary)]
    return done


def _replay(paths: Sequence[Path], options: ReplayOptions, progress: Progress, watch: Watch) -> Replay:
    session = open_session(paths, choice_of(options))
    for note in session.notes:
        log.info("%s", note)
    for warning in session.warnings:
        log.warning("%s", warning)
    setup = set_up(session, options)
    compiling = KernelProgress(lambda k: progress(k.share, COMPILING))
    begin = None if options.map is None else begin_in(options.map, setup.mapping, setup.map_version)
    log.info("mapping the scans of %s", ", ".join(setup.lasers))
    warm_up_encoding()
    compile_kernels = partial(warm_up_in_turn, compiling)
    compile_kernels()
    return ReplayRun(session, setup, begin, options.profile is None, compile_kernels, progress, watch).run()


def _replay_from_raw(
    paths: Sequence[Path], options: ReplayOptions, progress: Progress, watch: Watch
) -> Replay:
    with TemporaryDirectory(prefix="corridor-") as folder:
        made = Path(folder) / paths[0].name
        remade = remake_frames(paths, options.config, made, lambda share: progress(share, REMAKING))
        done = _replay([made], replace(options, from_raw=False), progress, watch)
    done.summary[FROM_RAW] = remade
    return done


def replay_to(
    session: Sequence[Path],
    options: ReplayOptions,
    out: Path,
    extras: Collection[Extra] = (),
    progress: Progress = lambda share, phase: None,
    watch: Watch | None = None,
) -> dict[str, Any]:
    """Replay one session and write its result to a folder or a URL; its summary. Raises CorridorError."""
    refuse_unwritable_folder(out)
    _begin_result(out, options.map)
    done = replay(session, options, progress, watch)
    write_replay(done, out, extras)
    return done.summary


def _begin_result(out: Path, begun_in: Path | None) -> None:
    """From here on a folder or a URL has no complete result. Raises UsageError where the new one would
    replace a map with edits, or the map it begins in, StorageError where a store refuses.
    """
    if begun_in is not None and begun_in.resolve() == (out / MAP_FOLDER).absolute().resolve():
        raise UsageError(f"--map {begun_in} is read and would be replaced; name another folder by --out")
    try:
        if (out / UNEDITED).exists():
            raise UsageError(
                f"{out}: its map was edited (corridor map log {quote(str(out / MAP_FOLDER))}), and a new "
                "result would replace it; name another folder by --out, or delete this one"
            )
        (out / DONE_FILE).unlink(missing_ok=True)
    except UsageError:
        raise
    except Exception as error:  # each store raises its own
        raise StorageError(f"cannot write to {out}: {words_of(error)}") from error


def _part_of(progress: Progress, part: int, parts: int) -> Progress:
    """Mapping counts over all sessions; the other phases come again with each."""

    def tell(share: float | None, phase: str) -> None:
        progress((part + share) / parts if share is not None and phase == MAPPING else share, phase)

    return tell
