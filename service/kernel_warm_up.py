"""Every kernel that a config needs, compiled by two processes where the cache is cold.

numba compiles one kernel at a time and holds the interpreter meanwhile, so a second core helps only a second
process. What this one is to do falls into pieces; both take the next one until none is left. What the other
has compiled is read from the cache that both share, and what it has not is compiled here.
"""

import logging
import os
import threading
from collections.abc import Callable
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any

from numba.core import event

from service.interruption import children_do_not_hear, end_with_parent
from service.mapper.profiles import MappingConfig, mapping_config, rehearsals

log = logging.getLogger(__name__)


def warm_up(config: MappingConfig | None = None) -> None:
    """Compile the kernels that a config needs (None: those of every profile), or load them from the cache.

    Half a second where the cache holds them. Call ensure_cache_dir first.
    """
    pieces = _Pieces(rehearsals(config))
    helper = _Helper(config, pieces) if len(os.sched_getaffinity(0)) > 1 else None
    with event.install_listener("numba:compile", _AtFirstCompile(helper.start if helper else None)):
        while (k := pieces.claim()) is not None:
            pieces.do(k)
        for k in helper.finish() if helper else ():
            pieces.do(k)


class _Pieces:
    """Pieces of work that two threads claim, in order."""

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


class _AtFirstCompile(event.Listener):
    """Tells whether the cache is cold: what numba finds there it does not compile."""

    def __init__(self, act: Callable[[], None] | None) -> None:
        self._act = act

    def on_start(self, event: object) -> None:
        act, self._act = self._act, None
        if act is not None:
            act()

    def on_end(self, event: object) -> None: ...


class _Helper:
    """The other process, which ends with this one, and the thread that hands it one piece after the other."""

    def __init__(self, config: MappingConfig | None, pieces: _Pieces) -> None:
        self._section = None if config is None else config.model_dump(mode="json", exclude_defaults=True)
        self._pieces = pieces
        self._claimed: list[int] = []
        self._process: Any = None
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        if not self._pieces.left:
            return
        context = get_context("spawn")  # a forked child would inherit locks that it does not have
        ours, theirs = context.Pipe()
        self._process = context.Process(target=_help, args=(theirs, self._section), daemon=True)
        with children_do_not_hear():
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
        with ours:
            try:
                while ours.recv():
                    piece = self._pieces.claim()
                    if piece is not None:
                        self._claimed.append(piece)
                    ours.send(piece)
            except (EOFError, OSError):
                return


def _help(theirs: Connection, section: dict[str, Any] | None) -> None:
    """The process. What does not compile here does not compile there either, and is said there."""
    end_with_parent()
    work = rehearsals(None if section is None else mapping_config(section))
    try:
        while True:
            theirs.send(True)
            if (k := theirs.recv()) is None:
                return
            work[k]()
    except (EOFError, OSError):
        return
