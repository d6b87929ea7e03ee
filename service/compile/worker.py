"""A process that compiles kernels into the cache: `python -m service.compile.worker NICENESS`.

Each line of its input is a job as JSON, `null` the last; it ends at once where the input ends before. It
writes `null` to ask for a job, and the job when that is done.
"""

import json
import os
import subprocess
import sys
import threading
from queue import SimpleQueue

from service.compile.signatures import Job, start_compiler


class Worker(subprocess.Popen[bytes]):
    """The process, seen from the one that begins it. Ctrl-C of a terminal does not reach it."""

    def __init__(self, niceness: int = 0) -> None:
        command, pipe = [sys.executable, "-m", __name__, str(niceness)], subprocess.PIPE
        super().__init__(command, bufsize=0, stdin=pipe, stdout=pipe, start_new_session=True)

    def send(self, job: Job | None) -> None:
        """None: no more will come. Raises BrokenPipeError."""
        assert self.stdin is not None
        self.stdin.write(json.dumps(job).encode() + b"\n")


def job_of(line: str | bytes) -> Job | None:
    job = json.loads(line)
    return None if job is None else Job(*job)


def main() -> None:
    os.nice(int(sys.argv[1]))
    jobs: SimpleQueue[Job | None] = SimpleQueue()
    threading.Thread(target=_read, args=(jobs,), daemon=True).start()
    start_compiler()
    print("null", flush=True)
    while (job := jobs.get()) is not None:
        job.do()
        print(json.dumps(job), "null", sep="\n", flush=True)
    os._exit(0)  # the interpreter would take half a second to let go of what the compiler has made


def _read(jobs: "SimpleQueue[Job | None]") -> None:
    for line in sys.stdin:
        jobs.put(job := job_of(line))
        if job is None:
            return
    os._exit(1)  # whoever began this process has ended


if __name__ == "__main__":
    main()
