"""Runs the dialogue of a driver with its device: requests, answers, time-outs, pauses. No I/O, no clock.

A dialogue is a generator. It yields the next request or a `Pause`, and is sent the answer to the request, or
None where no answer came within the request's time-out or where the pause is over. So the order of a start-up
reads from top to bottom in the driver's dialogue.py; retries are loops there.
"""

from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar


class Request(Protocol):
    """What a dialogue yields to have it sent."""

    @property
    def timeout_s(self) -> float:
        """How long to wait for the answer, from the tick at which the request was handed out."""
        ...


@dataclass(frozen=True, slots=True)
class Pause:
    """Nothing is sent for so long."""

    seconds: float


RequestT = TypeVar("RequestT", bound=Request)
AnswerT = TypeVar("AnswerT")


class DialogueRunner(Generic[RequestT, AnswerT]):
    """Runs one dialogue at a time for a session, which encodes its requests and recognises their answers.

    A request is handed out by `tick` alone: the time of the tick is the best known moment of sending.
    Whatever the dialogue raises passes through `tick` and `answer`.

    start       makes the dialogue; it is called again by `restart`
    awaited     the request that was handed out and is not answered yet; None: no answer is due
    asked_ns    host time at which the newest request was handed out
    begun       the dialogue has made its first step
    ended       the dialogue has returned
    """

    def __init__(self, start: Callable[[], Generator[RequestT | Pause, AnswerT | None, None]]) -> None:
        self._start = start
        self._steps = start()
        self._unsent: RequestT | None = None
        self._deadline_ns: int | None = None  # end of time-out or pause; None: the next step is due now
        self.awaited: RequestT | None = None
        self.requested_ns = 0
        self.begun = False
        self.ended = False

    def tick(self, now_ns: int) -> RequestT | None:
        """The request to send at this moment, or None. Ends time-outs and pauses."""
        if self._unsent is None and (self._deadline_ns is None or now_ns >= self._deadline_ns):
            self._advance(None, now_ns)
        request, self._unsent = self._unsent, None
        if request is not None:
            self.awaited, self.requested_ns = request, now_ns
            self.wait_again(now_ns)
        return request

    def answer(self, answer: AnswerT, now_ns: int) -> None:
        """Give the dialogue the answer to `awaited`. Its next request is handed out by the next tick."""
        assert self.awaited is not None
        self._advance(answer, now_ns)

    def wait_again(self, now_ns: int) -> None:
        """Begin the time-out of `awaited` again: the device has announced that the answer follows."""
        assert self.awaited is not None
        self._deadline_ns = now_ns + round(self.awaited.timeout_s * 1e9)

    def restart(self) -> None:
        """Drop the dialogue and begin a new one at the next tick."""
        self._steps.close()
        self._steps = self._start()
        self._unsent = self.awaited = self._deadline_ns = None
        self.begun = self.ended = False

    def _advance(self, answer: AnswerT | None, now_ns: int) -> None:
        if self.ended:
            return
        self.awaited = None
        begun, self.begun = self.begun, True
        try:
            step = self._steps.send(answer) if begun else next(self._steps)
        except StopIteration:
            self.ended = True
            return
        if isinstance(step, Pause):
            self._deadline_ns = now_ns + round(step.seconds * 1e9)
        else:
            self._unsent = step
