"""The mapper in the thread that hands items in, not in a process: for tests of what stands around it."""

from collections.abc import Callable
from typing import Any

from service.mapper.mapping_session import MappingSession
from service.runtime.mapper_messages import Answer, Item, LongWork
from service.runtime.mapping import MappingLoop, PrepareMap, PrepareProfile, no_stored_maps, one_profile
from service.runtime.mapping_outputs import MappingOutputs

Answered = Callable[[Answer], None]


class InlineLink:
    """As much of MapperLink as an Intake and a HealthReport use. `now_ns` is the mapper's clock."""

    def __init__(
        self,
        mapper: MappingSession,
        outputs: MappingOutputs,
        is_deaf: bool = False,
        prepare_map: PrepareMap = no_stored_maps,
        prepare_profile: PrepareProfile = one_profile,
    ) -> None:
        self.now_ns = 0
        self.sent: list[Any] = []
        self.items: list[Item] = []
        self._outputs = outputs
        self._is_deaf = is_deaf
        self._answered: dict[int, Answered] = {}
        self.loop = MappingLoop(mapper, self._hear, (), lambda: self.now_ns, prepare_map, prepare_profile)

    @property
    def waiting(self) -> int:
        return len(self.items) - self.loop.number

    def next_number(self) -> int:
        return len(self.items) + 1

    def submit(self, item: Item, answered: Answered | None = None) -> None:
        self.items.append(item)
        if answered is not None:
            self._answered[item.number] = answered
        if not self._is_deaf:
            self.loop.take(item)
            self.loop.keep_up(is_idle=True)

    def finish(self) -> None:
        self.loop.finish()

    def _hear(self, message: Any) -> None:
        if isinstance(message, LongWork):
            return  # of a process
        self.sent.append(message)
        if not isinstance(message, Answer):
            self._outputs.heard(message)
        elif (answered := self._answered.pop(message.number, None)) is not None:
            answered(message)
