"""Commands from outside: JSON in, JSON out, each answered in bounded time and never executed twice.

Independent of Zenoh and of the verbs: a Verb names the model of its request and the function that starts
it; an Outcome is settled when the command is done, from any thread.
"""

import difflib
import json
import threading
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails

from service.errors import shortened

ANSWER_TIMEOUT_S = 8.0  # a get gives up after 10 s by default: the reason shall arrive before that
REMEMBER_S = 600.0
REMEMBER_MOST = 1000
LARGEST_REQUEST = 65_536  # bytes


class CommandError(Exception):
    """Why a command is not executed, as text for the client."""


class Request(BaseModel):
    """Base of the requests of all commands."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    id: Annotated[str, Field(min_length=1, max_length=64)] | None = None


class Outcome:
    """Result of one command. Settled once; later calls are ignored."""

    def __init__(self) -> None:
        self._settled = threading.Event()
        self._lock = threading.Lock()
        self._answer: dict[str, Any] = {}
        self._error = ""

    @property
    def settled(self) -> bool:
        return self._settled.is_set()

    def done(self, **answer: Any) -> None:
        self._settle(answer, "")

    def failed(self, error: str) -> None:
        self._settle({}, error)

    def wait(self, timeout_s: float) -> dict[str, Any]:
        """Raises CommandError where it failed, or is not settled in time."""
        if not self._settled.wait(timeout_s):
            raise CommandError(
                f"taken up, but not finished within {timeout_s:g} s; health tells how things stand, "
                "and the same request with the same id tells what became of it"
            )
        if self._error:
            raise CommandError(self._error)
        return self._answer

    def _settle(self, answer: dict[str, Any], error: str) -> None:
        with self._lock:
            if not self._settled.is_set():
                self._answer, self._error = answer, error
                self._settled.set()


@dataclass(frozen=True, slots=True)
class Verb:
    """start waits for nothing but a disk; it raises CommandError where the command cannot even be begun."""

    request: type[Request]
    start: Callable[[Any, Outcome], None]


@dataclass(frozen=True, slots=True)
class Answer:
    ok: bool
    body: bytes  # JSON


def refusal(error: str, **words: str) -> Answer:
    return Answer(False, json.dumps({"ok": False, **words, "error": shortened(error)}).encode())


@dataclass(frozen=True, slots=True)
class _Known:
    verb: str
    request: Request
    outcome: Outcome
    at_s: float


class CommandDispatcher:
    """Takes requests from any thread and waits with each until it is settled, at most answer_timeout_s."""

    def __init__(
        self,
        verbs: Mapping[str, Verb],
        answer_timeout_s: float = ANSWER_TIMEOUT_S,
        monotonic_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._verbs = verbs
        self._answer_timeout_s = answer_timeout_s
        self._monotonic_s = monotonic_s
        self._lock = threading.Lock()  # of all below
        self._known: OrderedDict[str, _Known] = OrderedDict()  # by id, oldest first
        self._counts: Counter[str] = Counter()

    @property
    def verbs(self) -> list[str]:
        """Commands that there are."""
        return list(self._verbs)

    def counts(self) -> Counter[str]:
        """Commands begun, by verb, and "refused"."""
        with self._lock:
            return Counter(self._counts)

    def answer(self, verb: str, payload: bytes) -> Answer:
        """Execute the command, or report why not."""
        words: dict[str, Any] = {}
        try:
            request = self._read(verb, payload)
            if request.id is not None:
                words["id"] = request.id
            body = {"ok": True, **words, **self._outcome(verb, request).wait(self._answer_timeout_s)}
        except CommandError as error:
            with self._lock:
                self._counts["refused"] += 1
            return refusal(str(error), **words)
        return Answer(True, json.dumps(body).encode())

    def _read(self, verb: str, payload: bytes) -> Request:
        if verb not in self._verbs:
            raise CommandError(f"there is no command {verb!r}; known: {', '.join(sorted(self._verbs))}")
        if len(payload) > LARGEST_REQUEST:
            raise CommandError(f"a request of {len(payload)} bytes; at most {LARGEST_REQUEST} are read")
        try:
            request = json.loads(payload) if payload else {}
        except (ValueError, RecursionError) as error:
            raise CommandError(f"the payload is no JSON: {error}; expected {self._expected(verb)}") from error
        if not isinstance(request, dict):
            raise CommandError(f"the payload is no JSON object; expected {self._expected(verb)}")
        model = self._verbs[verb].request
        try:
            return model.model_validate(request)
        except ValidationError as error:
            faults = "; ".join(_words(model, detail) for detail in error.errors(include_url=False))
            raise CommandError(f"{faults}; expected {self._expected(verb)}") from error

    def _expected(self, verb: str) -> str:
        """Expected payload such as {"text": ..., "id": ...} (id may be left out)."""
        fields = self._verbs[verb].request.model_fields
        names = sorted(fields, key=lambda name: not fields[name].is_required())
        shape = ", ".join(f'"{name}": ...' for name in names)
        spare = [name for name in names if not fields[name].is_required()]
        return f"{{{shape}}} ({', '.join(spare)} may be left out)"

    def _outcome(self, verb: str, request: Request) -> Outcome:
        """Start it, or find its outcome where it was requested before."""
        outcome = Outcome()
        with self._lock:
            self._forget()
            known = self._known.get(request.id) if request.id is not None else None
            if known is not None:
                if (known.verb, known.request) != (verb, request):
                    raise CommandError(
                        f"the id {request.id!r} was taken {self._monotonic_s() - known.at_s:.0f} s ago by "
                        f"{known.verb}, with other content; a new command needs a new id"
                    )
                return known.outcome
            if request.id is not None:
                self._known[request.id] = _Known(verb, request, outcome, self._monotonic_s())
        try:
            self._verbs[verb].start(request, outcome)  # without the lock: health and others must not wait
        except Exception as error:
            outcome.failed(str(error))
            with self._lock:
                if request.id is not None:
                    self._known.pop(request.id, None)
            raise
        with self._lock:
            self._counts[verb] += 1
        return outcome

    def _forget(self) -> None:
        too_old_s = self._monotonic_s() - REMEMBER_S
        while self._known:
            oldest = next(iter(self._known.values()))
            if oldest.at_s >= too_old_s and len(self._known) < REMEMBER_MOST:
                return
            self._known.popitem(last=False)


def _words(model: type[Request], detail: ErrorDetails) -> str:
    key = ".".join(map(str, detail["loc"]))
    match detail["type"]:
        case "extra_forbidden":
            near = difflib.get_close_matches(key, model.model_fields, n=1)
            return f"unknown key {key!r}" + (f", did you mean {near[0]!r}?" if near else "")
        case "missing":
            return f"{key!r} is missing"
        case _:
            why = detail["msg"].removeprefix("Value error, ").removeprefix("Input ").removeprefix("String ")
            return f"{key!r} {why}"
