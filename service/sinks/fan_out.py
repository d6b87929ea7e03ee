"""Everything that leaves the service, handed to every open sink. A sink that fails stops only itself."""

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from service.deadline import Deadline
from service.encoding import ERROR, Message, Status
from service.errors import CorridorError, StorageError
from service.outputs import TileUpdate, reason_value
from service.sinks.registry import SinkKind
from service.sinks.sink import MapStorage, SessionRecorder, Sink, SinkContext

log = logging.getLogger(__name__)

STALL_S = 3.0  # that a sink may take where this process neither computes nor writes meanwhile
LOOK_S = 0.1


class Sinks:
    """The open sinks, in the order of the registry.

    Thread-safe after `open`. `put` and its kin call one sink after the other, which never wait. What a sink
    raises there is counted, logged once, and makes its row in health an error.
    """

    def __init__(self, sinks: Iterable[Sink] = ()) -> None:
        """sinks   those that are open already"""
        self._sinks = list(sinks)
        self._lock = threading.Lock()  # of what follows
        self._faults: dict[str, str] = {}  # by name of the sink: why it does not work any more
        self._hung: set[str] = set()  # sinks that did not flush
        self._refused: Counter[str] = Counter()  # calls that raised, by name of the sink

    def open(self, kinds: Sequence[SinkKind], sections: Mapping[str, Any], context: SinkContext) -> None:
        """Open every kind that its section of the config does not switch off; all or none.

        sections   section of the config -> its model

        Raises StorageError where one cannot be opened.
        """
        try:
            for kind in kinds:
                sink = kind.open_sink(sections[kind.section], context)
                if sink is not None:
                    self._sinks.append(sink)
        except BaseException:
            self.close(Deadline())
            raise

    def session_recorder(self) -> SessionRecorder:
        """The first sink that is one. Raises LookupError."""
        for sink in self._sinks:
            if isinstance(sink, SessionRecorder):
                return sink
        raise LookupError("no sink of the registry records sessions; start_recording needs one")

    def map_storage(self) -> MapStorage:
        """The first sink that is one. Raises LookupError."""
        for sink in self._sinks:
            if isinstance(sink, MapStorage):
                return sink
        raise LookupError("no sink of the registry stores maps; save_map needs one")

    @property
    def wants_raw(self) -> bool:
        """Whether a sink takes the bytes of the devices."""
        return any(sink.wants_raw for sink in self._sinks)

    def start(self) -> None:
        """Raises StorageError where a sink cannot begin."""
        for sink in self._sinks:
            sink.start()

    def put(self, message: Message, arrived_ns: int | None = None) -> None:
        self._tell(lambda sink: sink.put(message, arrived_ns))

    def put_tiles(self, tiles: Sequence[TileUpdate], stamp_ns: int, log_ns: int) -> None:
        self._tell(lambda sink: sink.put_tiles(tiles, stamp_ns, log_ns))

    def put_metadata(self, name: str, values: Mapping[str, str]) -> None:
        self._tell(lambda sink: sink.put_metadata(name, values))

    def health(self) -> list[Status]:
        """One row a sink; an error where it raised, or a thread of it died."""
        return [self._row(sink) for sink in self._sinks]

    def status_words(self) -> list[str]:
        return [words for sink in self._sinks if (words := sink.status_words())]

    def places(self) -> dict[str, str]:
        """By name of the sink: where its output is found."""
        return {sink.name: place for sink in self._sinks if (place := sink.place())}

    def written(self) -> dict[str, list[Path]]:
        """By name of the sink: what it has completed on disk."""
        return {sink.name: sink.written() for sink in self._sinks}

    def thread_died(self, thread_name: str, error: BaseException) -> bool:
        """Note that a thread is gone; False where it belongs to no sink."""
        for sink in self._sinks:
            if thread_name == sink.name or thread_name.startswith(f"{sink.name}-"):
                self._fail(sink.name, f"thread {thread_name} died: {type(error).__name__}: {error}")
                return True
        return False

    def flush(self, deadline: Deadline) -> list[str]:
        """Flush all at the same time. What is lost, a sentence each; empty where all is well."""
        return [fault for _, fault in self._end("flush", deadline)]

    def close(self, deadline: Deadline) -> list[str]:
        """Close all at the same time, each even if another fails or hangs. What is lost, as of `flush`."""
        return [fault for error, fault in self._end("close", deadline) if isinstance(error, StorageError)]

    def _end(self, action: str, deadline: Deadline) -> list[tuple[BaseException | None, str]]:
        """Have every sink flush or close in a thread of its own; one that hangs is left behind, for good.

        Faults, with what was raised; None where one hangs.
        """
        sinks = [sink for sink in self._sinks if sink.name not in self._hung]
        endings = [_Ending(sink, action) for sink in sinks]
        _wait_while_they_work(endings, deadline)
        faults = []
        for ending in endings:
            if fault := ending.fault():
                if ending.is_running:
                    self._hung.add(ending.sink.name)
                self._fail(ending.sink.name, fault)
                faults.append((ending.error, fault))
        return faults

    def _tell(self, tell: Callable[[Sink], None]) -> None:
        for sink in self._sinks:
            try:
                tell(sink)
            except Exception as error:
                self._refuse(sink, error)

    def _refuse(self, sink: Sink, error: Exception) -> None:
        with self._lock:
            self._refused[sink.name] += 1
            is_first = self._refused[sink.name] == 1
        if is_first:
            log.error("sink %s does not take what it is given", sink.name, exc_info=error)
            self._fail(sink.name, f"it raised {type(error).__name__}: {error}; the log holds where")

    def _fail(self, name: str, fault: str) -> None:
        with self._lock:
            self._faults.setdefault(name, fault)

    def _row(self, sink: Sink) -> Status:
        try:
            row = sink.health()
        except Exception as error:
            self._refuse(sink, error)
            row = Status(sink.name, ERROR, "", {})
        with self._lock:
            fault, refused = self._faults.get(sink.name, ""), self._refused[sink.name]
        if not fault:
            return row
        values = {**row.values, "refused": str(refused), **reason_value("output_failed")}
        return Status(row.name, ERROR, fault, values)


def _wait_while_they_work(endings: Sequence["_Ending"], deadline: Deadline) -> None:
    """Until all have ended, the deadline, or nothing has been computed or written for STALL_S."""
    work, worked_s = _work_done(), time.monotonic()
    while (running := [ending for ending in endings if ending.is_running]) and deadline.left_s > 0.0:
        running[0].join(LOOK_S)
        if (done := _work_done()) != work:
            work, worked_s = done, time.monotonic()
        elif time.monotonic() - worked_s > STALL_S:
            deadline.found_hung()
            return


def _work_done() -> tuple[int, int]:
    """Bytes that this process has written to disks, and its processor time in fifths of a second: threads
    that idle take less than that.
    """
    counts = Path("/proc/self/io").read_text(encoding="ascii").split()
    return int(counts[counts.index("write_bytes:") + 1]), int(5.0 * time.process_time())


class _Ending:
    """A sink that flushes or closes."""

    def __init__(self, sink: Sink, action: str) -> None:
        self.sink = sink
        self._action = action
        self._work: Callable[[], None] = getattr(sink, action)
        self.error: BaseException | None = None
        self._began_s = time.monotonic()
        self._thread = threading.Thread(target=self._run, name=f"{sink.name}-{action}", daemon=True)
        self._thread.start()

    @property
    def is_running(self) -> bool:
        return self._thread.is_alive()

    def join(self, timeout_s: float) -> None:
        self._thread.join(timeout_s)

    def fault(self) -> str:
        """What went wrong up to now, "" if nothing did."""
        if self.is_running:
            took_s = time.monotonic() - self._began_s
            fault = f"{self.sink.name} did not {self._action} within {took_s:.0f} s"
        elif self.error is None:
            return ""
        elif isinstance(self.error, CorridorError):
            fault = str(self.error)
        else:
            fault = f"{self.sink.name} failed to {self._action}: {type(self.error).__name__}: {self.error}"
        is_expected = self.error is None or isinstance(self.error, CorridorError)
        log.error("%s", fault, exc_info=None if is_expected else self.error)
        return fault

    def _run(self) -> None:
        try:
            self._work()
        except BaseException as error:  # reported by `wait`
            self.error = error
