"""Mapper's processes forked from one that has imported and loaded all.

For tests of what such a process does. How it begins is tested in tests/system.
"""

import json
import os
import runpy
import select
import signal
import subprocess
import sys
import threading
from contextlib import suppress
from typing import Any

from tests.service.runtime.mappers import HOW


class Nursery:
    """One process with every kernel loaded, which forks a mapper whenever it is asked. In the place of the
    module subprocess.
    """

    PIPE = subprocess.PIPE
    TimeoutExpired = subprocess.TimeoutExpired

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def Popen(self, command: list[str], **_: object) -> "Forked":  # noqa: N802 - in the place of subprocess
        """What `python -m MODULE FOLDER` would do, in a session of its own."""
        _, _, module, folder = command
        return Forked(self._ask(module=module, folder=folder, how=os.environ.get(HOW, "")), self)

    def bury(self, pid: int) -> None:
        """Wait until a mapper that has ended is no zombie any more."""
        self._ask(bury=pid)

    def _ask(self, **what: Any) -> int:
        with self._lock:
            print(json.dumps(what), file=self._process.stdin, flush=True)
            return int(self._process.stdout.readline())

    def close(self) -> None:
        self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()


class Forked:
    """As much of a Popen as the mapper's link uses."""

    stdin = None

    def __init__(self, pid: int, nursery: Nursery) -> None:
        self.pid, self._nursery = pid, nursery
        try:
            self._ends: int | None = os.pidfd_open(pid)
        except ProcessLookupError:
            self._ends = None

    def wait(self, timeout_s: float) -> None:
        """Raises subprocess.TimeoutExpired."""
        if self._ends is None:
            return
        if not select.select([self._ends], [], [], timeout_s)[0]:
            raise subprocess.TimeoutExpired(str(self.pid), timeout_s)
        os.close(self._ends)
        self._ends = None
        self._nursery.bury(self.pid)


def main() -> None:
    from service.compile.warm_up import warm_up
    from service.encoding import warm_up as warm_up_encoding
    from service.mapper.profiles import build_mapper, mapping_config
    from service.mapstore import begin_in, graph_files, patch_files  # noqa: F401 - the process imports them
    from service.runtime import back_end, mapper_messages, mapping  # noqa: F401

    config = mapping_config()
    build_mapper(config, {})
    warm_up()
    warm_up_encoding()
    signal.signal(signal.SIGCHLD, lambda number, frame: _reap())
    for line in sys.stdin:
        wanted = json.loads(line)
        pid = wanted.get("bury")
        if pid:
            with suppress(ChildProcessError):
                os.waitpid(pid, 0)
        elif (pid := os.fork()) == 0:
            _be_a_mapper(**wanted)
        print(pid, flush=True)


def _reap() -> None:
    """No one asks how a mapper ended, but what it used is counted."""
    with suppress(ChildProcessError):
        while os.waitpid(-1, os.WNOHANG)[0]:
            pass


def _be_a_mapper(**wanted: Any) -> None:
    """Does not return."""
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    os.setsid()
    nothing = os.open(os.devnull, os.O_RDWR)
    for ours in (0, 1):
        os.dup2(nothing, ours)
    os.environ[HOW] = wanted["how"]
    sys.argv = [wanted["module"], wanted["folder"]]
    code = 1
    try:
        runpy.run_module(wanted["module"], run_name="__main__")
        code = 0
    except SystemExit as ended:
        code = ended.code if isinstance(ended.code, int) else 1
    finally:
        sys.stderr.flush()
        os._exit(code)


if __name__ == "__main__":
    main()
