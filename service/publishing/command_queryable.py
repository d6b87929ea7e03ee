"""cmd/<verb> on Zenoh: one queryable, a thread for each command that is being answered."""

import logging
from collections.abc import Callable
from functools import partial

import zenoh

from drivers.zenoh_callback import daemon_callback
from service.publishing.commands import Answer, refusal
from service.publishing.keys import vehicle_key
from service.publishing.query_workers import QueryWorkers

log = logging.getLogger(__name__)

MAX_LOGGED_BYTES = 300  # of a request and of its answer


class CommandQueryable:
    """Open when constructed. `answer` takes verb and payload; it may wait, in bounded time."""

    def __init__(self, session: zenoh.Session, vehicle: str, answer: Callable[[str, bytes], Answer]) -> None:
        self._answer = answer
        self._root = vehicle_key(vehicle, "cmd/")
        self._workers = QueryWorkers("zenoh")
        taken = daemon_callback(self._take, "zenoh-commands")
        self._queryable = session.declare_queryable(self._root + "*", taken, complete=True)

    def close(self) -> None:
        """Accept no more commands, and wait for the answers in progress; late ones are logged."""
        self._queryable.undeclare()  # type: ignore[no-untyped-call]
        self._workers.close()

    def _take(self, query: zenoh.Query) -> None:
        """Hand the query on; the next waits until it is."""
        key = str(query.key_expr)
        if "*" in key:
            # A query for everything is no command; `corridor/v1/*/cmd/pause` names no vehicle.
            with query:
                if "/cmd/" in key:
                    _refuse(query, f"a command has one key, {self._root}<verb>, without wildcards")
            return
        if refused := self._workers.start(key.removeprefix(self._root), partial(self._reply, key, query)):
            with query:
                _refuse(query, refused)

    def _reply(self, key: str, query: zenoh.Query) -> None:
        try:
            with query:  # without it the asker would wait until its timeout
                if str(query.parameters):
                    _refuse(query, "a command takes its settings as JSON in the payload, not behind a ?")
                    return
                payload = query.payload.to_bytes() if query.payload is not None else b""
                verb = key.removeprefix(self._root)
                answer = self._words(verb, payload)
                log.info("command %r %s: %s", verb, _shown(payload), _shown(answer.body))
                if answer.ok:
                    query.reply(key, answer.body, encoding=zenoh.Encoding.APPLICATION_JSON)
                else:
                    query.reply_err(answer.body, encoding=zenoh.Encoding.APPLICATION_JSON)
        except zenoh.ZError as error:
            log.error("%s was answered, but the reply was not delivered: %s", key, error)

    def _words(self, verb: str, payload: bytes) -> Answer:
        try:
            return self._answer(verb, payload)
        except Exception as error:  # no input from outside may end the service
            log.exception("command %s failed", verb)
            return refusal(f"{verb} failed: {error!r}; the service's log says more")


def _refuse(query: zenoh.Query, error: str) -> None:
    query.reply_err(refusal(error).body, encoding=zenoh.Encoding.APPLICATION_JSON)


def _shown(text: bytes) -> str:
    """For the log: on one line, and cut where it is long."""
    shown = text[:MAX_LOGGED_BYTES].decode(errors="replace")
    return repr(shown) + ("..." if len(text) > MAX_LOGGED_BYTES else "")
