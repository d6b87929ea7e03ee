"""The process beside the mapping in which a graph's back end does its work.

A process and not a thread, because the solver holds the interpreter while it works. One thread here speaks
with it: it sends a batch, waits for the answer, sends the next.
"""

import logging
import os
import queue
import signal
import threading
import time
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any

from service.mapper.background import BackEnd, WorkLostError

log = logging.getLogger(__name__)

NICENESS = 5  # a loop may close a little later; scans may not wait
STOP_S = 2.0


class BackEndProcess:
    """Does the work of one back end after the other. `start`, then `stop`; `new_worker` at any time.

    The process begins with the first back end, so a profile without a graph has none. When it dies, that is
    said once in the log, and all work from then on is lost; it ends when this process ends, however it ends.

    patience_s   how long result() of all its work may keep others waiting, taken together
    """

    def __init__(self, patience_s: float) -> None:
        self._jobs: queue.SimpleQueue[_Job | None] = queue.SimpleQueue()
        self._patience = _Patience(patience_s)
        self._thread: threading.Thread | None = None
        self._stopping = threading.Event()
        self._process: Any = None
        self.trouble = ""  # why it does nothing any more, "" while all is well

    @property
    def pid(self) -> int | None:
        """Of the process; None where there is none."""
        return self._process.pid if self._process is not None else None

    def start(self) -> None:
        self._thread = threading.Thread(target=self._run, name="back-end", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the process, whatever it is doing; what is still out is lost."""
        self._stopping.set()
        self._jobs.put(None)
        if self._process is not None:
            self._process.kill()
        if self._thread is not None:
            self._thread.join(STOP_S)

    def new_worker(self, back_end: BackEnd) -> "ProcessWorker":
        self._jobs.put(_Job("begin", back_end))
        return ProcessWorker(self._jobs, self._patience)

    def _run(self) -> None:
        ours: Connection | None = None
        while (job := self._jobs.get()) is not None:
            if job.abandoned:
                continue
            if ours is None and not self.trouble:
                ours = self._begin()
            self._do(job, ours)
        if ours is not None:
            ours.close()
        if self._process is not None:
            self._process.join(STOP_S)

    def _begin(self) -> Connection:
        context = get_context("spawn")  # a forked child would inherit locks that it does not have
        ours, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs,), name="back-end", daemon=True)
        self._process.start()
        theirs.close()
        if self._stopping.is_set():
            self._process.kill()
        return ours

    def _do(self, job: "_Job", ours: Connection | None) -> None:
        if ours is None or self.trouble:
            job.fail(self.trouble)
            return
        try:
            ours.send((job.kind, job.payload))
            kind, answer = ours.recv()
        except (EOFError, OSError):
            self._process.join(STOP_S)
            self._give_up(f"the back end's process died (exit code {self._process.exitcode})")
            job.fail(self.trouble)
            return
        job.payload = None
        if kind == "failed":
            self._give_up(f"the back end failed: {answer}")
            job.fail(self.trouble)
        else:
            job.succeed(answer)

    def _give_up(self, trouble: str) -> None:
        self.trouble = trouble
        if not self._stopping.is_set():
            log.error("%s; mapping goes on without closing loops", trouble)


class ProcessWorker:
    """Worker of one back end in the process."""

    def __init__(self, jobs: "queue.SimpleQueue[_Job | None]", patience: "_Patience") -> None:
        self._jobs = jobs
        self._patience = patience
        self._closed = threading.Event()

    def submit(self, batch: Any) -> "ProcessPending":
        job = _Job("work", batch, self._closed)
        self._jobs.put(job)
        return ProcessPending(job, self._patience)

    def close(self) -> None:
        self._closed.set()


class ProcessPending:
    """Pending of what the process does."""

    def __init__(self, job: "_Job", patience: "_Patience") -> None:
        self._job = job
        self._patience = patience

    @property
    def ready(self) -> bool:
        return self._job.settled.is_set()

    def result(self) -> Any:
        if not self._patience.wait(self._job.settled):
            raise WorkLostError(f"the back end did not finish within {self._patience.allowed_s:g} s")
        if self._job.error:
            raise WorkLostError(self._job.error)
        return self._job.answer


class _Job:
    def __init__(self, kind: str, payload: Any, closed: threading.Event | None = None) -> None:
        self.kind = kind
        self.payload = payload
        self.settled = threading.Event()
        self.answer: Any = None
        self.error = ""
        self._closed = closed

    @property
    def abandoned(self) -> bool:
        return self._closed is not None and self._closed.is_set()

    def succeed(self, answer: Any) -> None:
        self.answer = answer
        self.settled.set()

    def fail(self, error: str) -> None:
        self.payload, self.error = None, error
        self.settled.set()


class _Patience:
    """Seconds of waiting that all may use up together."""

    def __init__(self, allowed_s: float) -> None:
        self.allowed_s = self._left_s = allowed_s

    def wait(self, event: threading.Event) -> bool:
        began_s = time.monotonic()
        came = event.wait(max(self._left_s, 0.0))
        self._left_s -= time.monotonic() - began_s
        return came


def _serve(connection: Connection) -> None:
    """The process: ends when the other side is gone. Who stops the service stops it too, by that."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    os.nice(NICENESS)
    back_end: BackEnd | None = None
    try:
        while True:
            kind, payload = connection.recv()
            try:
                if kind == "begin":
                    back_end, answer = payload, None
                else:
                    assert back_end is not None
                    answer = back_end.work(payload)
            except Exception as error:  # whatever it is, the state of the back end is unknown now
                connection.send(("failed", f"{type(error).__name__}: {error}"))
                return
            connection.send(("done", answer))
    except (EOFError, OSError):
        return
