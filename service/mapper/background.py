"""Back-end work of a graph, run beside the mapping: jobs, workers, results.

The mapper has no threads and reads no clock. Its builder chooses the worker: inline (replay, tests) or a
process of its own (live). A back end receives its batches one at a time and in order, so its results depend
on the batches alone. The mapper applies a result between two frames, at a position that the recording stores.
"""

from collections import deque
from collections.abc import Callable
from typing import Any, Protocol


class WorkLostError(Exception):
    """A job will never be finished; the message gives the reason. The state of the back end is lost."""


class BackEndDiedError(Exception):
    """The process of the back end died; a copy of this process holds a copy of the back end and continues."""


class BackEnd(Protocol):
    """Plain state that can be pickled, as can batches and results. Uses no unseeded random numbers."""

    def work(self, batch: Any) -> Any: ...


class Job(Protocol):
    """One batch that was submitted to a worker."""

    @property
    def ready(self) -> bool:
        """Whether result() returns at once, with a result or an error."""
        ...

    def result(self) -> Any:
        """Result of the batch; waits for it. Raises WorkLostError."""
        ...


class Worker(Protocol):
    """Passes batches to one back end, in order."""

    def submit(self, batch: Any) -> Job:
        """Submit a batch. Never waits and never raises."""
        ...

    def close(self) -> None:
        """Release the back end; no further batches follow."""
        ...


NewWorker = Callable[[BackEnd], Worker]


class Done:
    """A finished Job."""

    ready = True

    def __init__(self, result: Any) -> None:
        self._result = result

    def result(self) -> Any:
        return self._result


class InlineWorker:
    """Runs each batch in submit()."""

    def __init__(self, back_end: BackEnd) -> None:
        self._back_end = back_end

    def submit(self, batch: Any) -> Done:
        return Done(self._back_end.work(batch))

    def close(self) -> None: ...


class BackgroundJobs:
    """Jobs of a graph that are not applied yet, oldest first; implements Graph.waiting and Graph.ready.

    fault   why no more results will come, "" if none; from then on submit does nothing
    """

    def __init__(self, worker: Worker) -> None:
        self._worker = worker
        self._out: deque[Job] = deque()
        self.fault = ""

    @property
    def waiting(self) -> int:
        """Number of jobs whose results are not taken yet."""
        return len(self._out)

    @property
    def ready(self) -> bool:
        """Whether the result of the oldest job can be taken without waiting."""
        return bool(self._out) and self._out[0].ready

    def submit(self, batch: Any) -> None:
        if not self.fault:
            self._out.append(self._worker.submit(batch))

    def take(self) -> Any:
        """Result of the oldest job; waits for it. Raises WorkLostError and drops all jobs."""
        try:
            return self._out.popleft().result()
        except WorkLostError as error:
            self.fault = str(error)
            self._out.clear()
            raise

    def close(self) -> None:
        self._out.clear()
        self._worker.close()
