"""Base of the graphs with a back end."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, Generic, TypeVar

from service.geometry.se2 import SE2
from service.mapper.background import BackEnd, BackgroundJobs, NewWorker, WorkLostError
from service.mapper.components import GraphUpdate

ResultT = TypeVar("ResultT")


class BackgroundGraph(ABC, Generic[ResultT]):
    """The part of Graph that talks to the back end: submits batches, applies results, oldest first."""

    def __init__(self, back_end: BackEnd, new_worker: NewWorker) -> None:
        self._jobs = BackgroundJobs(new_worker(back_end))
        self._pose_map_odom = SE2()

    @property
    def waiting(self) -> int:
        return self._jobs.waiting

    @property
    def ready(self) -> bool:
        return self._jobs.ready

    @property
    def fault(self) -> str:
        return self._jobs.fault

    @property
    def finds_segments(self) -> bool:
        return False

    def apply_result(self) -> GraphUpdate | None:
        if not self.waiting:
            return None
        try:
            result: ResultT = self._jobs.take()
        except WorkLostError:
            self._give_up()
            return GraphUpdate({"graph_work_lost": 1})
        return self._bring_in(result)

    def close(self) -> None:
        self._jobs.close()

    def _apply_all(self, counts: dict[str, int]) -> GraphUpdate:
        """Apply all results, waiting for them, and sum their counts; returns the last update."""
        last = GraphUpdate({})
        while (update := self.apply_result()) is not None:
            add_counts(counts, update.counts)
            last = update
        return last

    @abstractmethod
    def _bring_in(self, result: ResultT) -> GraphUpdate:
        """Changes by a result of the back end."""

    def _give_up(self) -> None:
        """Clean up: no result will come any more."""


def add_counts(counts: dict[str, int], more: Mapping[str, Any]) -> None:
    for name, count in more.items():
        counts[name] = counts.get(name, 0) + count
