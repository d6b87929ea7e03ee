"""Kernels that not every scan asks for, compiled by another process while scans are mapped already.

    mapper    kernels of every scan | READY | scans --------------------- loads one where nothing waits -->
    process                                 | niceness 19, compiles the others into the cache | ends

A scan that asks for one before that has it compiled where it stands, and those behind it wait.
"""

import logging
import os
import sys
from collections import deque
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

from numba.core import event

from service.interruption import children_do_not_hear, end_with_parent
from service.kernel_warm_up import KERNEL_PACKAGE, start_compiler
from service.mapper.profiles import MappingConfig, mapping_config, seldom_steps

log = logging.getLogger(__name__)

LAST = 19  # niceness: any other program goes first


class Compiled(NamedTuple):
    """A kernel that stands in the cache."""

    module: str
    name: str
    types: tuple[Any, ...]  # numba's, of its arguments


class SeldomKernels:
    """Begins the process; `load_next` in turn with other work until `is_done`. No thread."""

    def __init__(self, config: MappingConfig) -> None:
        context = get_context("spawn")  # a forked child would have the mapper's sockets, too
        self._ours, theirs = context.Pipe(duplex=False)
        self._compiled: deque[Compiled] = deque()
        self._goes_on = True
        section = config.model_dump(mode="json", exclude_defaults=True)
        process = context.Process(target=compile_seldom, args=(theirs, section), daemon=True)
        with children_do_not_hear():
            process.start()
        theirs.close()

    @property
    def is_done(self) -> bool:
        return not self._goes_on and not self._compiled

    def load_next(self) -> None:
        """Load a kernel that has been compiled meanwhile, which takes some milliseconds; never waits."""
        self._hear()
        if not self._compiled:
            return
        kernel = self._compiled.popleft()
        getattr(sys.modules[kernel.module], kernel.name).compile(kernel.types)

    def _hear(self) -> None:
        try:
            while self._goes_on and self._ours.poll():
                step: list[Compiled] | None = self._ours.recv()
                if step is None:
                    self._end()
                else:
                    self._compiled += step
        except (EOFError, OSError):
            log.warning("the process that compiles seldom kernels has ended; they are compiled when needed")
            self._end()

    def _end(self) -> None:
        self._goes_on = False
        self._ours.close()


class _Collecting(event.Listener):
    """What Python calls of what numba compiles; it is in the cache when the call that needed it returns."""

    def __init__(self) -> None:
        self.compiled: list[Compiled] = []

    def on_start(self, event: event.Event) -> None:
        pass

    def on_end(self, event: event.Event) -> None:
        kernel = event.data["dispatcher"]
        function = kernel.py_func
        if function.__module__.startswith(KERNEL_PACKAGE) and not kernel.targetoptions.get(
            "no_cpython_wrapper"
        ):
            self.compiled.append(Compiled(function.__module__, function.__name__, event.data["args"]))


def compile_seldom(theirs: Connection, section: dict[str, Any]) -> None:
    """The process: sends a list of Compiled after each step, None after the last."""
    end_with_parent()
    os.nice(LAST)
    start_compiler()
    for step in seldom_steps(mapping_config(section), back_end_elsewhere=True):
        collecting = _Collecting()
        with event.install_listener("numba:compile", collecting):
            step()
        theirs.send(collecting.compiled)
    theirs.send(None)
