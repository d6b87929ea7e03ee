"""Every kernel that a config needs, compiled by one process per core where the cache is cold.

numba compiles one kernel at a time and holds the interpreter meanwhile, so a further core needs a process of
its own. The work falls into pieces; each process takes the next one until none is left. What the others have
compiled is read from the cache that all share, and what they have not is compiled here.
"""

import gc
import logging
import os
import pickle
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import current_process, get_context
from multiprocessing.connection import Connection
from types import ModuleType
from typing import Any

from numba.core import event
from numba.core.dispatcher import Dispatcher
from numba.core.registry import cpu_target

from service.interruption import children_do_not_hear, end_with_parent
from service.kernel_cache import compiling_alone, forget_kernels
from service.kernel_compiler import load_compiler
from service.mapper.profiles import MappingConfig, mapping_config, seldom_steps, warm_up_steps

log = logging.getLogger(__name__)

KERNEL_PACKAGE = "service.kernels."
TELL_S = 2.0  # how often the log says how far it is
CUT_SHORT = (EOFError, pickle.UnpicklingError)  # a file of the cache that a power cut left empty or in part
BACK_END_PACKAGE = ".graph."  # shared, or of one profile


class KernelProgress:
    """How many kernels have been compiled. Threads may add and ask.

    on_change   called after each kernel, by the thread that tells of it
    """

    def __init__(self, on_change: Callable[["KernelProgress"], None] = lambda progress: None) -> None:
        self._on_change = on_change
        self._began_s = time.monotonic()
        self._compiled: set[str] = set()
        self._needed = 0

    def compiled(self, name: str) -> None:
        """The kernel `name` (module and function), here or in the process that helps."""
        if not name.startswith(KERNEL_PACKAGE):
            return  # what numba brings along
        self._compiled.add(name)
        self._on_change(self)

    def expect(self, needed: int) -> None:
        """So many kernels at most will be compiled."""
        self._needed = needed

    @property
    def share(self) -> float:
        """0 to 1; 0 where none had to be compiled."""
        return len(self._compiled) / max(self._needed, 1)

    def __str__(self) -> str:
        taken_s = time.monotonic() - self._began_s
        if not self._compiled:
            return f"loading kernels, {taken_s:.0f} s"
        return f"compiling kernels: {len(self._compiled)} of {self._needed}, {taken_s:.0f} s"


class _Tell:
    """Writes a progress to the log, now and then."""

    def __init__(self) -> None:
        self._told_s = time.monotonic()

    def __call__(self, progress: KernelProgress) -> None:
        if time.monotonic() - self._told_s >= TELL_S:
            self._told_s = time.monotonic()
            log.info("%s", progress)


def warm_up(
    config: MappingConfig | None = None,
    back_end_elsewhere: bool = False,
    progress: KernelProgress | None = None,
    leaves_seldom: bool = False,
) -> bool:
    """Compile the kernels that a config needs (None: those of every profile), or load them from the cache.

    Half a second where the cache holds them. Call ensure_cache_dir first. A cache that cannot be read is
    emptied, with a warning, and filled anew.

    back_end_elsewhere   leave out what the graph's back end needs, see `warm_up_steps`
    progress             told of each kernel that is compiled; left out, the log says how far it is
    leaves_seldom        leave out what not every scan needs and the cache does not hold
    Returns whether that was left out.
    """
    progress = progress or KernelProgress(_Tell())
    start_compiler()
    try:
        return _warm_up(config, back_end_elsewhere, progress, leaves_seldom)
    except CUT_SHORT as error:
        if not forget_kernels():
            raise
        log.warning("compiled kernels could not be read (%r); all are compiled anew", error)
        return _warm_up(config, back_end_elsewhere, progress, leaves_seldom)


_loaded: set[str] = set()  # configs whose kernels this process has loaded


def warm_up_once(config: MappingConfig, progress: KernelProgress) -> None:
    """As warm_up; nothing where this process has done it. It takes a third of a second from the cache: longer
    than a short recording takes to be mapped.
    """
    if (known := config.model_dump_json()) not in _loaded:
        with compiling_alone():
            warm_up(config, progress=progress)
        _loaded.add(known)


def _warm_up(
    config: MappingConfig | None, back_end_elsewhere: bool, progress: KernelProgress, leaves_seldom: bool
) -> bool:
    steps = warm_up_steps(config, back_end_elsewhere)
    seldom = seldom_steps(config, back_end_elsewhere) if leaves_seldom else []
    pieces = _Pieces(steps[: len(steps) - len(seldom)])
    helpers = [
        _Helper((config, back_end_elsewhere), pieces, progress)
        for _ in range(len(os.sched_getaffinity(0)) - 1)
    ]
    is_cold = False

    def help_out() -> None:
        nonlocal is_cold
        is_cold = True
        progress.expect(len(needed_kernels(back_end_elsewhere)))
        for helper in helpers:
            helper.start()

    with _collecting_last():
        with _listening(help_out, progress.compiled):
            while (k := pieces.claim()) is not None:
                pieces.do(k)
            for helper in helpers:
                for k in helper.finish():
                    pieces.do(k)
        if is_cold:
            return bool(seldom)
        return sum(not _is_cached(step) for step in seldom) > 0  # a start that was cut short leaves a part


class _NotCachedError(Exception):
    """A kernel would have to be compiled."""


def _is_cached(step: Callable[[], Any]) -> bool:
    """Load what it calls, up to the first kernel that the cache does not hold; whether it held all."""

    def give_up() -> None:
        raise _NotCachedError

    with _listening(give_up, lambda name: None):
        try:
            step()
        except _NotCachedError:
            return False
    return True


def needed_kernels(back_end_elsewhere: bool = False) -> set[str]:
    """Module and name of every kernel that the modules imported by now may call, without those that only the
    graph's back end calls where that works elsewhere.
    """
    load_compiler()
    found: dict[str, Dispatcher] = {}
    callers = [m for name, m in list(sys.modules.items()) if name.startswith("service.") and m is not None]
    waiting = [
        value
        for module in callers
        if not module.__name__.startswith(KERNEL_PACKAGE)
        and not (back_end_elsewhere and BACK_END_PACKAGE in module.__name__)
        for value in list(vars(module).values())
        if isinstance(value, Dispatcher)
    ]
    while waiting:
        kernel = waiting.pop()
        name = _name_of(kernel)
        if name in found:
            continue
        found[name] = kernel
        around, code = kernel.py_func.__globals__, kernel.py_func.__code__
        waiting += [around[word] for word in code.co_names if isinstance(around.get(word), Dispatcher)]
    return set(found)


def _name_of(kernel: Dispatcher) -> str:
    return f"{kernel.py_func.__module__}.{kernel.py_func.__qualname__}"


def start_compiler() -> None:
    """Have numba read its registries, without scipy.

    It would import scipy.linalg only to know whether np.dot can be had: half of the time that this takes. No
    kernel multiplies matrices that way.
    """
    load_compiler()
    if "scipy.linalg" in sys.modules:
        return
    sys.modules["scipy.linalg"] = None  # type: ignore[assignment]
    try:
        cpu_target.typing_context.refresh()
        cpu_target.target_context.refresh()
    finally:
        del sys.modules["scipy.linalg"]


@contextmanager
def _collecting_last() -> Iterator[None]:
    """Searches the objects of the compiler for garbage when all is compiled. Searches meanwhile take a tenth
    of the time; without any, the process needs 200 MB more.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


@contextmanager
def _listening(at_first: Callable[[], None], compiled: Callable[[str], None]) -> Iterator[None]:
    with event.install_listener("numba:compile", _Listener(at_first, compiled)):
        yield


@contextmanager
def _without_main() -> Iterator[None]:
    """Have a process that begins here not import the main module: a script that maps as it is imported would
    do so once more in there.
    """
    main, sys.modules["__main__"] = sys.modules["__main__"], ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


class _Pieces:
    """Pieces of work that threads claim, in order."""

    def __init__(self, work: list[Callable[[], Any]]) -> None:
        self._work = work
        self._claimed = 0
        self._lock = threading.Lock()

    @property
    def left(self) -> int:
        return len(self._work) - self._claimed

    def claim(self) -> int | None:
        with self._lock:
            if not self.left:
                return None
            self._claimed += 1
            return self._claimed - 1

    def do(self, k: int) -> None:
        self._work[k]()


class _Listener(event.Listener):
    """Tells when numba compiles, which it does only with what is not in the cache: when first, and what."""

    def __init__(self, at_first: Callable[[], None], compiled: Callable[[str], None]) -> None:
        self._at_first: Callable[[], None] | None = at_first
        self._compiled = compiled

    def on_start(self, event: event.Event) -> None:
        act, self._at_first = self._at_first, None
        if act is not None:
            act()

    def on_end(self, event: event.Event) -> None:
        self._compiled(_name_of(event.data["dispatcher"]))


class _Helper:
    """Another process, which ends with this one, and the thread that hands it one piece after the other."""

    def __init__(
        self, what: tuple[MappingConfig | None, bool], pieces: _Pieces, progress: KernelProgress
    ) -> None:
        config, self._back_end_elsewhere = what
        self._section = None if config is None else config.model_dump(mode="json", exclude_defaults=True)
        self._pieces = pieces
        self._progress = progress
        self._claimed: list[int] = []
        self._process: Any = None
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        if not self._pieces.left or current_process().daemon:  # a daemon of multiprocessing has no children
            return
        context = get_context("spawn")  # a forked child would inherit locks that it does not have
        ours, theirs = context.Pipe()
        what = (self._section, self._back_end_elsewhere)
        self._process = context.Process(target=_help, args=(theirs, what), daemon=True)
        with children_do_not_hear(), _without_main():
            self._process.start()
        theirs.close()
        self._thread = threading.Thread(
            target=self._hand_out, args=(ours,), name="warm-up-helper", daemon=True
        )
        self._thread.start()

    def finish(self) -> list[int]:
        """Wait for it; the pieces that it took."""
        if self._thread is not None:
            self._thread.join()
            self._process.join()
            if self._process.exitcode:
                log.warning(
                    "the process that helps to compile ended with code %d; its part is compiled here",
                    self._process.exitcode,
                )
        return self._claimed

    def _hand_out(self, ours: Connection) -> None:
        """It sends the names of what it has compiled, and None for the next piece, please."""
        with ours:
            try:
                while True:
                    if (name := ours.recv()) is not None:
                        self._progress.compiled(name)
                        continue
                    piece = self._pieces.claim()
                    if piece is not None:
                        self._claimed.append(piece)
                    ours.send(piece)
            except (EOFError, OSError):
                return


def _help(theirs: Connection, what: tuple[dict[str, Any] | None, bool]) -> None:
    """The process. What does not compile here does not compile there either, and is said there."""
    end_with_parent()
    section, back_end_elsewhere = what
    start_compiler()
    work = warm_up_steps(None if section is None else mapping_config(section), back_end_elsewhere)
    try:
        with _collecting_last(), _listening(lambda: None, theirs.send):
            while True:
                theirs.send(None)
                if (k := theirs.recv()) is None:
                    break
                work[k]()
    except (EOFError, OSError):
        return
    theirs.close()
    os._exit(0)  # the interpreter would take half a second to let go of what the compiler has made
