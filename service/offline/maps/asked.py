"""What the operator's page may ask of a stored map, as JSON; all of it bounded."""

from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter, ValidationError

from service.errors import InputError, fault_words
from service.mapper.edit_requests import (
    AddPairs,
    Asked,
    Cut,
    Erase,
    Number,
    Optimize,
    Point,
    RemovePair,
    Undo,
    Wall,
    Who,
)


class Look(Asked):
    """Versions, pairs and key frames of the map as it is now."""


class LookAtKeyframe(Asked):
    """The points that a key frame saw."""

    version: Number
    keyframe: Number


class LookAtVersion(Asked):
    """The tiles of a version, to be compared with the present ones."""

    version: Number


class Pair(Asked):
    """Two points of the map that are one place, and the key frames that saw them."""

    points: tuple[Point, Point]
    keyframes: tuple[Number, Number]


class RefuseLoop(Asked):
    """loop    its number in the list of accepted ones"""

    what: Literal["refuse-loop"]
    loop: Number


class UndoTo(Undo):
    """to    number of the version to go back to; None: the one before the newest edit"""

    to: Number | None = None


ChangeAsked = Annotated[
    Erase | Wall | Cut | AddPairs[Pair] | RemovePair | RefuseLoop | Optimize | UndoTo,
    Field(discriminator="what"),
]


class Edit(Asked):
    """One change. version: the one that the person saw; who: "" for the user of the command"""

    version: Number
    who: Who = ""
    change: ChangeAsked


class KeyframeOfSession(Asked):
    """The points that a key frame saw. seen: what SessionMapCommands gave for a look"""

    seen: str
    keyframe: Number


Request = Look | LookAtKeyframe | LookAtVersion | Edit
REQUESTS: dict[str, TypeAdapter[Any]] = {
    "map_look": TypeAdapter(Look),
    "map_keyframe": TypeAdapter(LookAtKeyframe),
    "map_version": TypeAdapter(LookAtVersion),
    "map_edit": TypeAdapter(Edit),
}
VERBS = tuple(REQUESTS)


def read_asked(verb: str, payload: bytes) -> Request:
    """What a page asks. Raises InputError, which names what is wrong."""
    if verb not in REQUESTS:
        raise InputError(f"this is a stored map; it knows {', '.join(VERBS)}")
    asked: Request = read_as(REQUESTS[verb], payload)
    return asked


def read_as(kind: TypeAdapter[Any], payload: bytes) -> Any:
    """Raises InputError, which names what is wrong."""
    try:
        return kind.validate_json(payload)
    except ValidationError as error:
        raise InputError(fault_words(error)) from error
