"""Compiles the kernels that this process calls before the first scan, or loads them from the cache.

numba compiles one kernel at a time and keeps the interpreter locked meanwhile, and the memory that it takes
(0.5 GB) stays with its process. So processes of their own compile, one a core; each takes the next kernel
until none is left. This one then loads all from the shared cache, and compiles what is not there.
"""

import logging
import os
import pickle
import threading
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

from numba.core import event
from numba.core.dispatcher import Dispatcher

from service.compile.cache import compiling_alone, forget_kernels
from service.compile.signatures import Job, code_length, jobs_of_process, start_compiler
from service.compile.worker import Worker

log = logging.getLogger(__name__)

CUT_SHORT = (EOFError, pickle.UnpicklingError)  # a file of the cache that a power cut left empty or in part


class KernelProgress:
    """How many of the kernels that are not in the cache have been compiled.

    on_change   called after each, by the thread that adds it
    """

    def __init__(
        self, on_change: Callable[["KernelProgress"], object] = lambda progress: log.info("%s", progress)
    ) -> None:
        self._on_change = on_change
        self._began_s = time.monotonic()
        self._lengths: list[int] = []
        self._done: list[int] = []

    def expect(self, jobs: Iterable[Job]) -> None:
        """These will be compiled."""
        self._lengths += [job.length for job in jobs]

    def done(self, job: Job) -> None:
        """It is compiled, here or in another process."""
        self._done.append(job.length)
        self._on_change(self)

    @property
    def share(self) -> float:
        """0 to 1, by length; 0 where none had to be compiled."""
        return sum(self._done) / max(sum(self._lengths), 1)

    def __str__(self) -> str:
        taken_s = time.monotonic() - self._began_s
        if not self._lengths:
            return f"loading kernels, {taken_s:.0f} s"
        return f"compiling kernels: {len(self._done)} of {len(self._lengths)}, {taken_s:.0f} s"


def warm_up(
    back_end_elsewhere: bool = False, progress: KernelProgress | None = None, leaves_seldom: bool = False
) -> list[Job]:
    """Compile the kernels that the modules imported by now call, or load them from the cache.

    Half a second where the cache has them, nothing where this process has them. Call ensure_cache_dir first.
    A cache that cannot be read is emptied, with a warning, and filled again.

    back_end_elsewhere   leave out what only the graph's back end calls: its process loads that itself
    progress             left out, the log reports it
    leaves_seldom        leave out what not every scan calls and the cache does not have
    Returns what is left out for that.
    """
    progress = progress or KernelProgress()
    start_compiler()
    jobs, seldom = jobs_of_process(back_end_elsewhere)
    try:
        missing = _missing(jobs + seldom)
    except CUT_SHORT as error:
        if not forget_kernels():
            raise
        log.warning("compiled kernels could not be read (%r); all are compiled again", error)
        missing = _missing(jobs + seldom)
    left = [job for job in missing if leaves_seldom and job in seldom]
    if now := [job for job in missing if job not in left]:
        progress.expect(now)
        _compile(now, progress)
    return left


def warm_up_in_turn(progress: KernelProgress) -> None:
    """As warm_up; of processes that share a cache one compiles at a time, and the others load that."""
    with compiling_alone():
        warm_up(progress=progress)


def _missing(jobs: Iterable[Job]) -> list[Job]:
    """Load what is in the cache; the rest."""

    def is_loaded(job: Job) -> bool:
        with suppress(_NotCachedError):
            job.do()
            return True
        return False

    with event.install_listener("numba:compile", _OnlyFromCache()):
        return [job for job in jobs if not is_loaded(job)]


class _NotCachedError(Exception):
    """A kernel would have to be compiled."""


class _OnlyFromCache(event.Listener):
    def on_start(self, event: event.Event) -> None:
        raise _NotCachedError

    def on_end(self, event: event.Event) -> None:
        return


class Jobs:
    """Not taken yet by any process. Each takes the one that shares most with what it has compiled: two that
    compile kernels with the same inner ones at a time would compile these twice.
    """

    def __init__(self, jobs: list[Job]) -> None:
        self._jobs = jobs
        self._lock = threading.Lock()

    def take(self, compiled: set[Dispatcher]) -> Job | None:
        """`compiled` by the process that takes the job; what the job reaches is added. None: none is left."""
        with self._lock:
            if not self._jobs:
                return None
            job = max(self._jobs, key=lambda job: (code_length(job.reached() & compiled), job.length))
            self._jobs.remove(job)
            compiled |= job.reached()
            return job

    def clear(self) -> None:
        with self._lock:
            self._jobs.clear()


def _compile(jobs: list[Job], progress: KernelProgress) -> None:
    """By a process for each core; this one loads the results, and compiles what is not in the cache then."""
    count = min(len(os.sched_getaffinity(0)), len(jobs))
    waiting = Jobs(list(jobs))
    with ThreadPoolExecutor(count, "warm-up-helper") as pool:
        helpers = [pool.submit(_help, waiting, progress) for _ in range(count)]
        try:
            compiled = {job for helper in helpers for job in helper.result()}
        finally:
            waiting.clear()
    for job in jobs:
        job.do()
        if job not in compiled:
            progress.done(job)


def _help(jobs: Jobs, progress: KernelProgress) -> list[Job]:
    """Have a process compile one job after the other; those that it has compiled."""
    done: list[Job] = []
    job, compiled = None, set[Dispatcher]()
    with Worker() as worker:
        while worker.wait_for_line():
            if job is not None:
                done.append(job)
                progress.done(job)
            job = jobs.take(compiled)
            worker.send(job)
            if job is None:
                break
    if worker.returncode:
        log.warning(
            "a process that compiles kernels ended with code %d; what is left is compiled here",
            worker.returncode,
        )
    return done
