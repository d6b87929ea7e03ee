"""Wishes to the mapper, as they stand among the events of a recording."""

import json
from typing import get_args

from service.encoding.outputs import decode_event
from service.errors import InputError
from service.mapper.steering import Control, Steering

STEERINGS: tuple[Steering, ...] = get_args(Steering)


def decode_control(payload: bytes, log_ns: int) -> Control | None:
    """The wish in a message of channel "events"; None where it tells of something else.

    Raises InputError on bytes that are no such message.
    """
    text = decode_event(payload)
    try:
        event = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"an event that is no JSON: {text[:80]!r}") from error
    what = event.get("event") if isinstance(event, dict) else None
    return Control(what, log_ns) if what in STEERINGS else None
