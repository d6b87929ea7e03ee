"""A process that compiles kernels into the cache: `python -m service.compile.worker NICENESS`.

It writes an empty line when it is ready and after each job. Each line of its input is a job as JSON, `null`
the last. It ends with the process that began it.

    mapper    kernels of every scan | READY | scans -------------- loads a seldom one where nothing waits -->
    worker                                  | niceness 19, compiles seldom kernels into the cache | ends
"""

import gc
import json
import logging
import os
import select
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress

from service.compile.signatures import Job, start_compiler
from service.interruption import killed_with_parent

log = logging.getLogger(__name__)

LAST = 19  # niceness: any other program goes first


class Worker(subprocess.Popen[bytes]):
    """The process, seen from the one that begins it. Ctrl-C of a terminal does not reach it."""

    def __init__(self, niceness: int = 0) -> None:
        command, pipe = [sys.executable, "-m", __name__, str(niceness)], subprocess.PIPE
        super().__init__(command, bufsize=0, stdin=pipe, stdout=pipe, start_new_session=True)

    def send(self, job: Job | None) -> None:
        """None: no more will come. A process that has ended ignores it."""
        assert self.stdin is not None
        with suppress(BrokenPipeError):
            self.stdin.write(json.dumps(job).encode() + b"\n")

    def wait_for_line(self) -> bool:
        """Wait until it is ready for a job; False where it has ended."""
        assert self.stdout is not None
        return bool(self.stdout.readline())


class SeldomKernels:
    """Kernels that not every scan calls, compiled by a worker while scans are mapped.

    Call `load_next` in turn with other work until `is_done`. No thread. A scan that calls one earlier has it
    compiled in the mapper.
    """

    def __init__(self, jobs: Sequence[Job]) -> None:
        self._worker = Worker(LAST)
        self._left: list[Job | None] = [None, *jobs]  # None: the line that says that it is ready
        for job in [*jobs, None]:
            self._worker.send(job)

    @property
    def is_done(self) -> bool:
        return not self._left

    def fileno(self) -> int:
        """Readable when load_next has something to do."""
        assert self._worker.stdout is not None
        return self._worker.stdout.fileno()

    def load_next(self) -> None:
        """Load a kernel that has been compiled meanwhile, which takes some milliseconds; never waits."""
        if not select.select([self], [], [], 0.0)[0]:
            return
        if self._worker.wait_for_line():
            if (job := self._left.pop(0)) is not None:
                job.do()
        else:
            log.warning("the process that compiles seldom kernels has ended; they are compiled when needed")
            self._left.clear()
        if self.is_done:
            with self._worker:  # closes its pipes
                pass


def main() -> None:
    os.nice(int(sys.argv[1]))
    gc.disable()  # collections of the compiler's objects take a tenth of the time; without, 200 MB more
    with killed_with_parent(), suppress(BrokenPipeError):  # the process that this one works for is ending
        start_compiler()
        print(flush=True)
        for line in sys.stdin:
            if (job := json.loads(line)) is None:
                break
            Job(*job).do()
            print(flush=True)
    os._exit(0)  # the interpreter would take half a second to free what the compiler has made


if __name__ == "__main__":
    main()
