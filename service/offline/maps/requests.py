"""Requests of the operator's page to a stored map, as JSON; all of it bounded."""

from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError

from service.errors import InputError, fault_words
from service.mapper.edit_requests import (
    AddPairs,
    Cut,
    Erase,
    Number,
    Optimize,
    Point,
    RemovePair,
    RequestModel,
    Undo,
    Wall,
    Who,
)


class Look(RequestModel):
    """Versions, pairs and key frames of the map as it is now."""


class LookAtKeyframe(RequestModel):
    """The points that a key frame saw."""

    version: Number
    keyframe: Number


class LookAtVersion(RequestModel):
    """The tiles of a version, to be compared with the present ones."""

    version: Number


class Pair(RequestModel):
    """Two points of the map that are one place, and the key frames that saw them."""

    points: tuple[Point, Point]
    keyframes: tuple[Number, Number]


class RefuseLoop(RequestModel):
    """loop    its number in the list of accepted ones"""

    what: Literal["refuse-loop"]
    loop: Number


class UndoTo(Undo):
    """to    number of the version to go back to; None: the one before the newest edit"""

    to: Number | None = None


ChangeRequest = Annotated[
    Erase | Wall | Cut | AddPairs[Pair] | RemovePair | RefuseLoop | Optimize | UndoTo,
    Field(discriminator="what"),
]


class Edit(RequestModel):
    """One change. version: the one that the person saw; who: "" for the user of the command"""

    version: Number
    who: Who = ""
    change: ChangeRequest


class KeyframeOfSession(RequestModel):
    """The points that a key frame saw. seen: what SessionMapCommands gave for a look"""

    seen: str
    keyframe: Number


Table = Mapping[
    str, tuple[type[RequestModel], Callable[[Any], dict[str, Any]]]
]  # verb -> request, who does it


def carry_out(table: Table, verb: str, payload: bytes, what: str = "this is a stored map") -> dict[str, Any]:
    """Carries out the request of a page. Raises InputError, which names what is wrong."""
    if verb not in table:
        raise InputError(f"{what}; it knows {', '.join(table) or 'no command'}")
    kind, do = table[verb]
    try:
        requested = kind.model_validate_json(payload)
    except ValidationError as error:
        raise InputError(fault_words(error)) from error
    return do(requested)
