"""Steps between two frames, from recorded events: requests, results applied, frames left out."""

import json
from typing import Literal, get_args

from service.encoding.outputs import decode_event
from service.errors import InputError
from service.mapper.mapping_session import (
    GRAPH_REQUESTS,
    ApplyResult,
    GraphRequest,
    LeftOut,
    LoadMap,
    SessionAction,
    SessionRequest,
    Step,
    SwitchProfile,
)

SESSION_ACTIONS: tuple[SessionAction, ...] = get_args(SessionAction)
LOAD_MAP = "load_map"
SWITCH_PROFILE = "switch_profile"
APPLY_RESULT = "apply_result"
LEFT_OUT: dict[str, Literal["old", "fatal"]] = {
    "scan_passed_over": "old",
    "frame_refused": "fatal",
    "frame_left_out": "fatal",  # the mapper never had it
}


def decode_step(payload: bytes, log_ns: int) -> Step | None:
    """The step in a message of channel "events"; None where it tells of something else.

    Raises InputError on bytes that are no such message.
    """
    text = decode_event(payload)
    try:
        event = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"an event that is no JSON: {text[:80]!r}") from error
    what = event.get("event") if isinstance(event, dict) else None
    if what in SESSION_ACTIONS:
        return SessionRequest(what, log_ns)
    if what == LOAD_MAP and isinstance(event.get("map"), str) and isinstance(event.get("version"), int):
        return LoadMap(event["map"], event["version"], log_ns)
    if what == SWITCH_PROFILE and isinstance(event.get("profile"), str):
        return SwitchProfile(event["profile"], log_ns)
    if what == APPLY_RESULT:
        return ApplyResult(log_ns)
    if isinstance(what, str) and what in LEFT_OUT and isinstance(event.get("sensor"), str):
        return LeftOut(event["sensor"], LEFT_OUT[what], log_ns)
    if what in GRAPH_REQUESTS:
        return GraphRequest(what, {key: event[key] for key in event if key not in ("event", "id")}, log_ns)
    return None
