"""Kernels that not every scan calls, compiled by another process while scans are mapped already.

    mapper    kernels of every scan | READY | scans --------------------- loads one where nothing waits -->
    process                                 | niceness 19, compiles the others into the cache | ends

A scan that calls one before that has it compiled where it stands, and those behind it wait.
"""

import logging
import os
from collections import deque
from collections.abc import Sequence
from contextlib import suppress

from service.compile.signatures import Job
from service.compile.worker import Worker, job_of

log = logging.getLogger(__name__)

LAST = 19  # niceness: any other program goes first


class SeldomKernels:
    """Begins the process; `load_next` in turn with other work until `is_done`. No thread."""

    def __init__(self, jobs: Sequence[Job]) -> None:
        self._worker: Worker | None = Worker(LAST)
        assert self._worker.stdout is not None
        os.set_blocking(self._worker.stdout.fileno(), False)
        self._left = len(jobs)
        self._compiled: deque[Job] = deque()
        self._part = b""  # of a line
        with suppress(BrokenPipeError):  # it has ended, which `_hear` finds
            for job in [*jobs, None]:
                self._worker.send(job)

    @property
    def is_done(self) -> bool:
        return self._worker is None and not self._compiled

    def load_next(self) -> None:
        """Load a kernel that has been compiled meanwhile, which takes some milliseconds; never waits."""
        if self._worker is not None:
            self._hear(self._worker)
        if self._compiled:
            self._compiled.popleft().do()

    def _hear(self, worker: Worker) -> None:
        assert worker.stdout is not None
        if (text := worker.stdout.read()) is None:
            return
        *lines, self._part = (self._part + text).split(b"\n")
        done = [job for line in lines if (job := job_of(line)) is not None]
        self._compiled += done
        self._left -= len(done)
        if text:
            return
        if self._left:
            log.warning("the process that compiles seldom kernels has ended; they are compiled when needed")
        with worker:  # closes its pipes
            self._worker = None
