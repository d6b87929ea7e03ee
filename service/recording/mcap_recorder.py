"""Records messages to MCAP sessions from a thread of its own; whoever puts never waits for a disk.

A session is one or more files `<vehicle>_<UTC start>_<nnnn>.mcap`, each complete by itself. While a file is
written it is called `*.mcap.active` and locked; it is flushed and synced each second, so a crash costs at
most that. What a crash left behind is recovered at the next start, in a process of its own.

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

from service.encoding import Message
from service.errors import StorageError
from service.recording.mcap_file import ACTIVE_SUFFIX, LATCHED, McapFile, StreamOpener, create_stream
from service.recording.mcap_recovery import Leftovers

log = logging.getLogger(__name__)

SYNC_PERIOD_S = 0.9  # with the flush and the sync themselves, less than a second is at risk
QUEUE_MESSAGES, QUEUE_BYTES = 20_000, 64 << 20  # a disk may stall for a minute before scans are lost
RETRY_S = 5.0  # after a disk error, until a new file is tried
RESUME_FACTOR = 1.05  # free space must exceed the limit by this before recording resumes, or it would flutter
FINISH_TIMEOUT_S = 30.0

State = Literal["waiting", "recording", "disk full", "disk error", "finished"]


@dataclass(frozen=True, slots=True)
class _Metadata:
    name: str
    values: dict[str, str]


@dataclass(slots=True)
class RecorderHealth:
    """What is known of the recording. Written by its thread, read by anyone."""

    state: State = "waiting"
    path: Path | None = None  # the file being written
    finished: list[Path] = field(default_factory=list)
    messages: int = 0  # written, in all files
    dropped: Counter[str] = field(default_factory=Counter)  # by channel, for whatever reason
    steps_back: int = 0  # messages whose log time lay before that of an earlier one
    free_bytes: int = 0
    last_error: str = ""


class McapRecorder:
    """Puts messages on disk. `start`, then `put` from any thread, at the end `finish`.

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
        self._wake = threading.Condition()  # guards the queue, its size, stopping and health.dropped
        self._queue: deque[Message | _Metadata] = deque()
        self._queue_bytes = 0
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._leftovers: Leftovers | None = None
        self._file: McapFile | None = None
        self._session = ""
        self._file_count = 0
        self._latched: dict[str, Message] = {}
        self._last_log_ns = 0
        self._sync_at_s = 0.0
        self._retry_at_s = 0.0
        self.health = RecorderHealth()

    @property
    def recovering(self) -> bool:
        """Whether files of an earlier run are still being recovered."""
        return self._leftovers is not None and self._leftovers.running

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
            if len(self._queue) >= QUEUE_MESSAGES or self._queue_bytes >= QUEUE_BYTES:
                self._drop(message, f"{len(self._queue)} messages wait; the disk does not keep up")
                return
            self._queue.append(message)
            self._queue_bytes += len(message.payload)
            self._wake.notify()

    def put_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write metadata now (a step of the clock, say) and into every later file; the last one wins."""
        with self._wake:
            self._queue.append(_Metadata(name, dict(values)))
            self._wake.notify()

    def finish(self) -> list[Path]:
        """Write what is queued, complete the file and stop. Returns the session's files, oldest first."""
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

    def _run(self) -> None:
        while True:
            with self._wake:
                if not self._queue and not self._stopping:
                    self._wake.wait(max(self._sync_at_s - self._monotonic_s(), 0.01))
                batch, self._queue, self._queue_bytes = self._queue, deque(), 0
                stopping = self._stopping
            for item in batch:
                self._take(item)
                self._sync_if_due()
            self._sync_if_due()
            if stopping and not self._queue:
                self._close()
                self.health.state = "finished"
                return

    def _take(self, item: Message | _Metadata) -> None:
        try:
            if isinstance(item, _Metadata):
                self._metadata[item.name] = item.values
                if self._file is not None:
                    self._file.write_metadata(item.name, item.values)
                return
            if item.channel in LATCHED:
                self._latched[item.channel] = item
            if self._may_write():
                self._write(item)
                return
        except Exception as error:  # whatever ails this file or message, the next may be well
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
        file.write(message)
        self.health.messages += 1
        self.health.steps_back += message.log_ns < self._last_log_ns
        self._last_log_ns = message.log_ns

    def _open(self, first: Message) -> McapFile:
        if not self._session:
            start = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(first.log_ns // 1_000_000_000))
            self._session = f"{self._vehicle}_{start}"
        while True:
            self._file_count += 1
            path = self._directory / f"{self._session}_{self._file_count:04d}.mcap"
            if not path.exists() and not path.with_name(path.name + ACTIVE_SUFFIX).exists():
                break
        file = self._file = McapFile(path, first.log_ns, self._open_stream)
        self.health.path = file.active_path
        for name, values in self._metadata.items():
            file.write_metadata(name, values)
        for message in self._latched.values():
            if message is not first:
                file.write(message, log_ns=first.log_ns)
        log.info("recording to %s", file.active_path)
        self.health.state = "recording"
        return file

    def _sync_if_due(self) -> None:
        if self._monotonic_s() < self._sync_at_s:
            return
        if self._file is not None:
            try:
                self._file.sync()
                if not self._has_room(self._keep_free_bytes):
                    self._close()
            except Exception as error:  # as in _take
                self._abandon(error)
        self._sync_at_s = self._monotonic_s() + SYNC_PERIOD_S

    def _close(self) -> None:
        file, self._file = self._file, None
        if file is None:
            return
        try:
            file.finish()
        except Exception as error:  # as in _take
            self._file = file
            self._abandon(error)
            return
        self.health.path = None
        self.health.finished.append(file.path)

    def _abandon(self, error: Exception) -> None:
        file, self._file = self._file, None
        where = self._directory if file is None else file.active_path
        self.health.last_error = f"{where}: {error}"
        self.health.state, self.health.path = "disk error", None
        self._retry_at_s = self._monotonic_s() + RETRY_S
        log.error("recording: %s; a new file is tried in %.0f s", self.health.last_error, RETRY_S)
        if file is not None:
            try:
                file.abandon()
            except OSError as second:
                log.debug("recording: closing %s: %s", where, second)

    def _drop(self, message: Message, reason: str) -> None:
        if not self.health.dropped[message.channel]:
            log.warning("recording drops %s: %s", message.channel, reason)
        self.health.dropped[message.channel] += 1
