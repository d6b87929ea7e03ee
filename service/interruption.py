"""Ctrl-C and SIGTERM from the first moment of a command on: the process and its children end at once.

Raising KeyboardInterrupt would not do: between two instructions of a compiler or an import it is lost,
printed, or delayed until a long call of C returns. So nothing is unwound. A command that has something to
finish takes the signals over (service.runtime.signals); it gives them back where none came.
"""

import fcntl
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
INTERRUPTED = 130  # 128 + SIGINT, as shells have it
PR_SET_PDEATHSIG = 1  # prctl(2)

_cleanups: list[Callable[[], object]] = []
_ends = threading.RLock()  # never let go: of two threads that hear one signal the first ends the process


def before_ending(cleanup: Callable[[], object]) -> None:
    """Have it done before the process ends at once; atexit is passed over then."""
    _cleanups.append(cleanup)


def end_at_once(code: int) -> None:
    """Kill the children, clean up, end this process. Does not return."""
    _ends.acquire()
    for pid in set(_children()) - _left_to_end_by_themselves():
        try:
            os.kill(pid, signal.SIGKILL)
        except ProcessLookupError:
            continue
    while _cleanups:
        _cleanups.pop(0)()
    os._exit(code)


def end_on_signals(codes: dict[int, int]) -> None:
    """From now on each of ENDING ends this process at once. Main thread only, once a process.

    codes   exit code by signal number; 128 + number where a signal is not named
    """
    reader, writer = os.pipe()
    os.set_blocking(writer, False)

    def end(number: int, frame: FrameType | None = None) -> None:
        end_at_once(codes.get(number, 128 + number))

    def watch() -> None:
        # Python runs a handler when the main thread comes back from C, which may be a second later; the bytes
        # of signals that the wakeup descriptor gets, another thread reads at once.
        while numbers := os.read(reader, 64):
            for number in numbers:
                if number in codes or number in ENDING:
                    end(number)

    for number in ENDING:
        signal.signal(number, end)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    threading.Thread(target=watch, name="interruption", daemon=True).start()


def leave_signals_alone() -> None:
    """Python's own handlers again: Ctrl-C raises KeyboardInterrupt, the others end the process."""
    signal.set_wakeup_fd(-1)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


@contextmanager
def children_do_not_hear() -> Iterator[None]:
    """A process begun in here never hears Ctrl-C nor SIGHUP, which a terminal tells its whole group.

    Whoever begins it ends it. Such a process should watch its parent (`end_with_parent`).
    """
    from multiprocessing import resource_tracker

    resource_tracker.ensure_running()  # when it begins it unblocks SIGINT
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGHUP))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def end_with_parent() -> None:
    """In a process of multiprocessing: end when the parent has ended, whatever is being done."""
    from multiprocessing import connection, parent_process

    parent: Any = parent_process()
    assert parent is not None

    def watch() -> None:
        connection.wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, name="parent-watch", daemon=True).start()


@contextmanager
def killed_with_parent() -> Iterator[None]:
    """In here the system kills this process when the thread that began it ends, killed or not.

    A compiler that is at work reads no pipe and runs no watching thread. Of a parent that was gone before
    nothing is heard: the pipe or socket to it says so.
    """
    import ctypes  # what only checks a config does without

    libc, none = ctypes.CDLL(None), 0
    libc.prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    try:
        yield
    finally:
        libc.prctl(PR_SET_PDEATHSIG, none)


def wake_when_parent_ends() -> None:
    """From now on the system continues this process, where it is stopped, when the thread that began it ends.

    One that would end by itself then, or has to take over, does neither while it is stopped. Not inherited by
    a fork.
    """
    import ctypes

    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGCONT)


def wake_group_at_end_of(pipe: int) -> None:
    """From now on the system continues this process and all of its group, where they are stopped, when no one
    can write to the pipe any more. Every byte that comes through it does so, too.

    Unlike a parent's end, this reaches those whose parent has ended long before. Holds as long as one of the
    group has the pipe open.
    """
    fcntl.fcntl(pipe, fcntl.F_SETOWN, -os.getpgrp())
    fcntl.fcntl(pipe, fcntl.F_SETSIG, signal.SIGCONT)
    fcntl.fcntl(pipe, fcntl.F_SETFL, fcntl.fcntl(pipe, fcntl.F_GETFL) | os.O_ASYNC)


def _left_to_end_by_themselves() -> set[int]:
    """multiprocessing's tracker takes away the semaphores of those that were killed, then ends."""
    tracker = sys.modules.get("multiprocessing.resource_tracker")
    return set() if tracker is None else {tracker._resource_tracker._pid}


def _children() -> list[int]:
    """Process ids, also of children that no module of ours began, by the parent that each process names."""
    own, found = os.getpid(), []
    for name in filter(str.isdigit, os.listdir("/proc")):
        try:
            with open(f"/proc/{name}/stat", encoding="utf-8", errors="replace") as stat:
                parent = stat.read().rpartition(")")[2].split()[1]  # after the name, which may hold anything
        except (FileNotFoundError, ProcessLookupError):
            continue  # it has just ended
        if int(parent) == own:
            found.append(int(name))
    return found
