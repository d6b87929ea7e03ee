"""Queries to one vehicle, and to several at a time."""

import json
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import zenoh

from service.errors import CorridorError, StorageError
from service.publishing.keys import vehicle_key
from service.publishing.uplink import Presence

ANSWER_S = 30.0  # a checksum of a recording of 1 GB, on a slow disk
AT_ONCE = 16  # vehicles
ResultT = TypeVar("ResultT")


class RefusedError(CorridorError):
    """The vehicle has refused."""


def ask(
    session: zenoh.Session, vehicle: str, channel: str, payload: bytes = b"", timeout_s: float = ANSWER_S
) -> bytes:
    """The answer, which goes behind poses and tiles on the link. Raises RefusedError; StorageError where none
    comes.
    """
    replies = session.get(
        vehicle_key(vehicle, channel),
        payload=payload,
        timeout=timeout_s,
        priority=zenoh.Priority.BACKGROUND,
        congestion_control=zenoh.CongestionControl.BLOCK,
    )
    for reply in replies:
        if reply.ok is not None:
            return reply.ok.payload.to_bytes()
        if reply.err is not None and (words := _refusal(reply.err.payload.to_bytes())):
            raise RefusedError(f"{vehicle}: {words}")
    raise StorageError(f"{vehicle} does not answer {channel}; is it at the router, and may you command it?")


def ask_json(
    session: zenoh.Session, vehicle: str, channel: str, request: Mapping[str, Any] | None = None
) -> Any:
    """The answer as JSON, to a request in JSON. Raises as `ask`."""
    body = ask(session, vehicle, channel, b"" if request is None else json.dumps(request).encode())
    try:
        return json.loads(body)
    except ValueError as error:
        raise RefusedError(f"{vehicle}: the answer to {channel} is no JSON: {error}") from error


def for_each(vehicles: Sequence[str], work: Callable[[str], ResultT]) -> dict[str, ResultT | CorridorError]:
    """Result of `work` for each vehicle, or why it failed; AT_ONCE at the same time, each once."""

    def attempt(vehicle: str) -> ResultT | CorridorError:
        try:
            return work(vehicle)
        except CorridorError as error:
            return error

    once = list(dict.fromkeys(vehicles))
    with ThreadPoolExecutor(AT_ONCE) as pool:
        return dict(zip(once, pool.map(attempt, once), strict=True))


def namesakes(sessions: Sequence[Presence]) -> RefusedError | None:
    """Why none of two vehicles by one name is queried: either might answer. None: there is one."""
    if len(sessions) < 2:
        return None
    return RefusedError(
        f"two vehicles by this name: {'; '.join(map(str, sessions))}; give one of them another name"
    )


def _refusal(body: bytes) -> str:
    """The vehicle's error text; "" where the error is Zenoh's own time-out."""
    try:
        return str(json.loads(body)["error"])
    except (ValueError, KeyError, TypeError):
        return ""
