"""Records messages to MCAP sessions in a thread of its own; `put` never waits for a disk.

A session is one or more files `<vehicle>_<UTC start>_<nnnn>.mcap`, each complete by itself. While a file is
written it is called `*.mcap.active` and locked; it is flushed and synced several times in two seconds, so a
crash costs less than one. What a crash left behind is recovered at the next start, in a process of its own.

Log times are written as they come: `arrived_ns` of a decoded frame is its log time, so to change one here
would change the replay. Messages of equal log time keep their order in the file, for our reader and for
others.
"""

import logging
import os
import shutil
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from drivers.counted import counted
from service.encoding import Message
from service.errors import StorageError, words_of
from service.recording.mcap_file import ACTIVE_SUFFIX, LATCHED, McapFile, StreamOpener, create_stream
from service.recording.mcap_recovery import Leftovers
from service.recording.session_change import SessionChange, SessionHeard

log = logging.getLogger(__name__)

SYNC_PERIOD_S = 0.6  # with a batch, flush, sync and waiting for a busy processor, a second is at risk
BATCH_S = 0.05  # the thread wakes so often, not for each message: a wake-up costs more than the writing
BATCH_BYTES = 1 << 20  # and at once where so much waits
QUEUE_MESSAGES, QUEUE_BYTES = 20_000, 64 << 20  # a disk may stall for a minute before scans are lost
RAW_SUFFIX, RAW_SHARE = "/raw", 0.5  # of the queue: bytes as they came never push out the frames made of them
EVENTS = "events"
RETRY_S = 5.0  # after a disk error, until a new file is tried
RESUME_FACTOR = 1.05  # free space must exceed the limit by this before recording resumes, or it would flutter
FINISH_TIMEOUT_S = 30.0

State = Literal["waiting", "recording", "stopped", "disk full", "disk error", "finished"]


@dataclass(frozen=True, slots=True)
class _Metadata:
    name: str
    values: dict[str, str]


@dataclass(frozen=True, slots=True)
class _Begin:
    first: Message
    heard: SessionHeard


@dataclass(frozen=True, slots=True)
class _End:
    heard: SessionHeard


_Item = Message | _Metadata | _Begin | _End


@dataclass(slots=True)
class RecorderHealth:
    """State of the recording. Written by its thread, read by any thread."""

    state: State = "waiting"
    path: Path | None = None  # the file being written
    finished: list[Path] = field(default_factory=list)
    messages: int = 0  # written, in all files
    # By channel, for whatever reason; where the disk refuses a file, also what was not synced yet.
    dropped: Counter[str] = field(default_factory=Counter)
    steps_back: int = 0  # messages whose log time lay before that of an earlier one
    free_bytes: int = 0
    last_error: str = ""


class McapRecorder:
    """Puts messages on disk. `start`, then `put` from any thread, at the end `finish`.

    It begins to record at once. `end_session` and `begin_session` cut the stream of messages where they are
    called; what is put in between is let go, uncounted, but for what a new session has to know (LATCHED).
    Events of log times before the begin are let go, too: what the mapper decides about an earlier frame
    stands right ahead of that frame, which the session does not hold.

    directory          where sessions go; made if it is not there
    rotate_bytes       a new file when the current one is this large
    rotate_s           or covers this much log time
    keep_free_bytes    recording pauses while the disk has less than this, and resumes by itself
    metadata           name -> key -> text; opens every file: config, calibration, clocks, version
    open_stream, free_bytes_of, monotonic_s    for tests: the disk and the clock
    """

    def __init__(
        self,
        directory: Path,
        vehicle: str,
        rotate_bytes: int = 1 << 30,
        rotate_s: float = 600.0,
        keep_free_bytes: int = 2 << 30,
        metadata: Mapping[str, Mapping[str, str]] | None = None,
        *,
        open_stream: StreamOpener = create_stream,
        free_bytes_of: Callable[[Path], int] = lambda path: shutil.disk_usage(path).free,
        monotonic_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._directory = directory
        self._vehicle = vehicle
        self._rotate_bytes = rotate_bytes
        self._rotate_ns = round(rotate_s * 1e9)
        self._keep_free_bytes = keep_free_bytes
        self._metadata = {name: dict(values) for name, values in (metadata or {}).items()}
        self._open_stream = open_stream
        self._free_bytes_of = free_bytes_of
        self._monotonic_s = monotonic_s
        self._wake = threading.Condition()  # of what follows, and of health.dropped
        self._queue: deque[_Item] = deque()
        self._queue_bytes = 0
        self._is_requested = False  # a session is to begin or to end
        self._stopping = False

        self._thread = threading.Thread(target=self._run, name="recording-writer", daemon=True)
        self._leftovers: Leftovers | None = None
        self._file: McapFile | None = None
        self._active_paths: list[Path] = []  # of all files that were begun
        self._unsynced: Counter[str] = Counter()  # messages of that file since it was synced, by channel
        self._enabled = True
        self._session = ""
        self._session_began_s = 0
        self._session_files = 0  # how many were finished before it
        self._file_count = 0
        self._latched: dict[str, Message] = {}
        # Log time; an event before it is about a frame that the session does not hold.
        self._events_from_ns = 0
        self._last_log_ns = 0
        self._sync_at_s = 0.0
        self._retry_at_s = 0.0
        self._reported = ""  # what the disk said, "" once it has taken something again
        self.health = RecorderHealth()

    @property
    def recovering(self) -> bool:
        """Whether files of an earlier run are still being recovered."""
        return self._leftovers is not None and self._leftovers.running

    @property
    def unfinished(self) -> list[Path]:
        """Files of this run that are not complete: given up after an error, or being written."""
        return [path for path in self._active_paths if path.exists()]

    def start(self) -> None:
        """Begin to write, and to recover what an earlier run left unfinished. Raises StorageError."""
        try:
            self._directory.mkdir(parents=True, exist_ok=True)
            leftovers = sorted(self._directory.glob(f"*{ACTIVE_SUFFIX}"))
            self.health.free_bytes = self._free_bytes_of(self._directory)
        except OSError as error:
            raise StorageError(f"cannot record to {self._directory}: {error.strerror}") from error
        if not os.access(self._directory, os.W_OK | os.X_OK):
            raise StorageError(f"cannot record to {self._directory}: no right to write there")
        if leftovers:
            self._leftovers = Leftovers(leftovers)
        self._sync_at_s = self._monotonic_s() + SYNC_PERIOD_S
        self._thread.start()

    def put(self, message: Message) -> None:
        """Hand over a message. Never blocks; one that finds the queue full is dropped and counted."""
        with self._wake:
            if self._stopping:
                return
            share = RAW_SHARE if message.channel.endswith(RAW_SUFFIX) else 1.0
            if len(self._queue) >= QUEUE_MESSAGES * share or self._queue_bytes >= QUEUE_BYTES * share:
                self._drop(message, f"{len(self._queue)} messages wait; the disk does not keep up")
                return
            self._queue.append(message)
            self._queue_bytes += len(message.payload)
            if self._queue_bytes >= BATCH_BYTES:
                self._wake.notify()

    def put_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write metadata now (for example a step of the clock) and into every later file; the last one
        wins.
        """
        with self._wake:
            self._queue.append(_Metadata(name, dict(values)))

    def begin_session(self, first: Message, heard: SessionHeard) -> None:
        """Record again, into a new file that opens with metadata, latched messages and `first`.

        Where a session is being recorded it goes on, and takes `first`. `heard` is called by the recorder's
        thread and must not wait.
        """
        self._request(_Begin(first, heard))

    def end_session(self, heard: SessionHeard) -> None:
        """Complete the file with what was put until now, and record no more. `heard` as in begin_session."""
        self._request(_End(heard))

    def finish(self) -> list[Path]:
        """Write what is queued, complete the file and stop. Returns the files of this run, oldest first."""
        with self._wake:
            self._stopping = True
            self._wake.notify()
        if self._thread.ident is not None:
            self._thread.join(FINISH_TIMEOUT_S)
        if self._thread.is_alive():
            log.error(
                "recording: the disk did not take %s within %.0f s; it will be recovered at the next start",
                self.health.path,
                FINISH_TIMEOUT_S,
            )
        if self._leftovers is not None:
            self._leftovers.stop()
        return list(self.health.finished)

    def _request(self, request: _Begin | _End) -> None:
        with self._wake:
            if not self._stopping:
                self._queue.append(request)
                self._is_requested = True
                self._wake.notify()
                return
        request.heard(SessionChange(False, [], "the recorder is being stopped"))

    def _run(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(self._is_due, BATCH_S)
                batch, self._queue, self._queue_bytes = self._queue, deque(), 0
                self._is_requested = False
                stopping = self._stopping
            for item in batch:
                self._take(item)
                self._sync_if_due()
            self._sync_if_due()
            if stopping and not self._queue:
                self._close()
                if self.health.state != "disk error":
                    self.health.state = "finished"
                return

    def _is_due(self) -> bool:
        return self._stopping or self._is_requested or self._queue_bytes >= BATCH_BYTES

    def _take(self, item: _Item) -> None:
        match item:
            case _Begin():
                item.heard(self._begin(item.first))
            case _End():
                item.heard(self._end())
            case _:
                self._keep(item)

    def _begin(self, first: Message) -> SessionChange:
        changed = not self._enabled
        if changed:
            self._enabled, self._session, self._file_count = True, "", 0
            self._session_files = len(self.health.finished)
            self._events_from_ns = first.log_ns
            self._retry_at_s = 0.0
            self.health.state = "waiting"
        self._keep(first)
        if self._file is None:
            return SessionChange(changed, [], self.health.last_error)
        return SessionChange(changed, [self._file.active_path], "")

    def _end(self) -> SessionChange:
        changed, self._enabled = self._enabled, False
        broken = self._file
        self._close()
        error = self.health.last_error if self.health.state == "disk error" and broken is not None else ""
        self.health.state = "stopped"
        return SessionChange(changed, self.health.finished[self._session_files :], error)

    def _keep(self, item: Message | _Metadata) -> None:
        try:
            if isinstance(item, _Metadata):
                self._metadata[item.name] = item.values
                if self._file is not None:
                    self._file.write_metadata(item.name, item.values)
                return
            if item.channel in LATCHED:
                self._latched[item.channel] = item
            if not self._enabled or (item.channel == EVENTS and item.log_ns < self._events_from_ns):
                return
            if self._may_write():
                self._write(item)
                return
        except Exception as error:  # the next file or message may be written
            self._abandon(error)
        if isinstance(item, Message):
            with self._wake:
                self._drop(item, self.health.last_error)

    def _may_write(self) -> bool:
        if self._file is not None:
            return True
        if self._monotonic_s() < self._retry_at_s:
            return False
        resuming = self.health.state == "disk full"
        return self._has_room(self._keep_free_bytes * (RESUME_FACTOR if resuming else 1.0))

    def _has_room(self, limit_bytes: float) -> bool:
        self.health.free_bytes = self._free_bytes_of(self._directory)
        if self.health.free_bytes >= limit_bytes:
            return True
        if self.health.state != "disk full":
            self.health.last_error = (
                f"{self._directory} has {self.health.free_bytes / 1e9:.2f} GB free, less than the "
                f"{self._keep_free_bytes / 1e9:.2f} GB of recording.keep_free_gb; make room to record again"
            )
            log.error("recording paused: %s", self.health.last_error)
        self.health.state = "disk full"
        self._retry_at_s = self._monotonic_s() + SYNC_PERIOD_S
        return False

    def _write(self, message: Message) -> None:
        file = self._file
        if file is not None and (
            file.size >= self._rotate_bytes or message.log_ns - file.first_log_ns >= self._rotate_ns
        ):
            self._close()
            file = None
        if file is None:
            file = self._open(message)
            self._sync_at_s = self._monotonic_s()  # with this batch: until then the file is empty
        file.write(message)
        self._unsynced[message.channel] += 1
        self.health.messages += 1
        if message.channel.endswith(RAW_SUFFIX):
            return  # put by the readers themselves, ahead of frames that wait to be mapped
        self.health.steps_back += message.log_ns < self._last_log_ns
        self._last_log_ns = message.log_ns

    def _open(self, first: Message) -> McapFile:
        if not self._session:
            # never that of the session before: files of one name are one drive
            self._session_began_s = max(first.log_ns // 1_000_000_000, self._session_began_s + 1)
            start = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(self._session_began_s))
            self._session = f"{self._vehicle}_{start}"
        while True:
            self._file_count += 1
            path = self._directory / f"{self._session}_{self._file_count:04d}.mcap"
            if not path.exists() and not path.with_name(path.name + ACTIVE_SUFFIX).exists():
                break
        self._active_paths.append(path.with_name(path.name + ACTIVE_SUFFIX))
        file = self._file = McapFile(path, first.log_ns, self._open_stream)
        self.health.path = file.active_path
        for name, values in self._metadata.items():
            file.write_metadata(name, values)
        for message in self._latched.values():
            if message is not first:
                file.write(message, log_ns=first.log_ns)
        log.log(logging.DEBUG if self._reported else logging.INFO, "recording to %s", file.active_path)
        self.health.state = "recording"
        return file

    def _sync_if_due(self) -> None:
        if self._monotonic_s() < self._sync_at_s:
            return
        if self._file is not None:
            try:
                self._file.sync()
                self._unsynced.clear()
                if self._reported:
                    self._reported = ""
                    log.info("recording again, to %s", self._file.active_path)
                if not self._has_room(self._keep_free_bytes):
                    self._close()
            except Exception as error:  # as in _keep
                self._abandon(error)
        self._sync_at_s = self._monotonic_s() + SYNC_PERIOD_S

    def _close(self) -> None:
        file, self._file = self._file, None
        if file is None:
            return
        try:
            file.finish()
        except Exception as error:  # as in _keep
            self._file = file
            self._abandon(error)
            return
        self._unsynced.clear()
        self.health.path = None
        self.health.finished.append(file.path)

    def _abandon(self, error: Exception) -> None:
        file, self._file = self._file, None
        where = self._directory if file is None else file.active_path
        self.health.last_error = f"{where}: {words_of(error)}"
        self.health.state, self.health.path = "disk error", None
        self._retry_at_s = self._monotonic_s() + RETRY_S
        level = logging.DEBUG if words_of(error) == self._reported else logging.ERROR
        self._reported = words_of(error)
        log.log(level, "recording: %s; a new file is tried each %.0f s", self.health.last_error, RETRY_S)
        self._give_up_unsynced(level)
        if file is not None:
            file.abandon()

    def _give_up_unsynced(self, level: int) -> None:
        """Count it as dropped: what of it is on the disk is unknown; a recovery restores that."""
        if not self._unsynced:
            return
        log.log(
            level,
            "recording: %s not synced yet, counted as dropped",
            counted(self._unsynced.total(), "message"),
        )
        with self._wake:
            self.health.dropped.update(self._unsynced)
        self.health.messages -= self._unsynced.total()
        self._unsynced.clear()

    def _drop(self, message: Message, reason: str) -> None:
        if not self.health.dropped[message.channel]:
            log.warning("recording drops %s: %s", message.channel, reason)
        self.health.dropped[message.channel] += 1
