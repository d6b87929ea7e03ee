"""Work that a graph has done beside the mapping: what is handed out, and when it comes back in.

The mapper has no threads and reads no clock. Who builds it says where the work is done: at once and in place
(replay, tests), or in a process of its own (live). A back end gets its batches one at a time and in order, so
what it answers depends on the batches alone; and the mapper applies a result between two frames, at a place
that the recording holds.
"""

from collections import deque
from collections.abc import Callable
from typing import Any, Protocol


class WorkLostError(Exception):
    """A piece of work will never be done; says why. Nothing that the back end knew can be had any more."""


class BackEndDiedError(Exception):
    """The process of the back end is gone, and a copy of this one has a copy of it: that one goes on."""


class BackEnd(Protocol):
    """Plain state that can be pickled, as can batches and results. Draws no random numbers without a seed."""

    def work(self, batch: Any) -> Any: ...


class Job(Protocol):
    """One batch that was handed to a worker."""

    @property
    def ready(self) -> bool:
        """Whether result() answers at once, be it with an error."""
        ...

    def result(self) -> Any:
        """What the back end made of the batch; waits for it. Raises WorkLostError."""
        ...


class Worker(Protocol):
    """Gives one back end its batches, in order."""

    def submit(self, batch: Any) -> Job:
        """Never waits and raises nothing."""
        ...

    def close(self) -> None:
        """Nobody wants anything more of this back end."""
        ...


NewWorker = Callable[[BackEnd], Worker]


class Done:
    """A Job that is done."""

    ready = True

    def __init__(self, result: Any) -> None:
        self._result = result

    def result(self) -> Any:
        return self._result


class InlineWorker:
    """Does the work when it is handed in."""

    def __init__(self, back_end: BackEnd) -> None:
        self._back_end = back_end

    def submit(self, batch: Any) -> Done:
        return Done(self._back_end.work(batch))

    def close(self) -> None: ...


class DiscardingWorker:
    """For a mapper that warms up: what is handed in is never done, and never waited for."""

    ready = False

    def __init__(self, back_end: BackEnd) -> None: ...

    def submit(self, batch: Any) -> "DiscardingWorker":
        return self

    def result(self) -> Any:
        raise WorkLostError("this back end works elsewhere")

    def close(self) -> None: ...


class BackgroundJobs:
    """Jobs that a graph has out with its back end, oldest first; gives Graph.waiting and Graph.ready.

    fault   why there will be no more results, "" while all is well; from then on submit does nothing
    """

    def __init__(self, worker: Worker) -> None:
        self._worker = worker
        self._out: deque[Job] = deque()
        self.fault = ""

    @property
    def waiting(self) -> int:
        """Jobs whose results are not taken yet."""
        return len(self._out)

    @property
    def ready(self) -> bool:
        """Whether the result of the oldest can be taken without waiting."""
        return bool(self._out) and self._out[0].ready

    def submit(self, batch: Any) -> None:
        if not self.fault:
            self._out.append(self._worker.submit(batch))

    def take(self) -> Any:
        """Result of the oldest job; waits for it. Raises WorkLostError, then all are given up."""
        try:
            return self._out.popleft().result()
        except WorkLostError as error:
            self.fault = str(error)
            self._out.clear()
            raise

    def close(self) -> None:
        self._out.clear()
        self._worker.close()
