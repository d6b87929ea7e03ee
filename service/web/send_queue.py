"""Messages that wait for one browser. Bounded: of each kind only the newest stays."""

import asyncio
from collections import deque

Payload = str | bytes

MAX_NOTES = 64  # the oldest goes


class SendQueue:
    """Filled and emptied in the event loop; `filled` is set while something waits."""

    def __init__(self) -> None:
        self.filled = asyncio.Event()
        self.dropped = 0  # payloads that a newer one replaced before they were sent
        self._newest: dict[str, Payload] = {}
        self._answers: list[Payload] = []
        self._notes: deque[Payload] = deque()

    def put(self, key: str, payload: Payload) -> None:
        """A state or a picture: the newest under its key replaces what waits."""
        if self._newest.pop(key, None) is not None:
            self.dropped += 1
        self._newest[key] = payload
        self.filled.set()

    def answer(self, payload: Payload) -> None:
        """Queue an answer; none is left out. The queue grows by what the browser may request within the
        time after which one that does not read is disconnected.
        """
        self._answers.append(payload)
        self.filled.set()

    def note(self, payload: Payload) -> None:
        """Queue an event; the newest are sent."""
        if len(self._notes) >= MAX_NOTES:
            self._notes.popleft()
            self.dropped += 1
        self._notes.append(payload)
        self.filled.set()

    def wake(self) -> None:
        """Have the sender look for tiles."""
        self.filled.set()

    def take(self) -> list[Payload]:
        """All that waits, answers first, then notes; nothing waits afterwards."""
        self.filled.clear()
        taken = [*self._answers, *self._notes, *self._newest.values()]
        self._answers.clear()
        self._notes.clear()
        self._newest.clear()
        return taken
