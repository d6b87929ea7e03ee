"""What the operator's page may ask of a stored map, as JSON; all of it bounded."""

from collections.abc import Sequence
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from service.errors import InputError

MOST_CORNERS = 500  # of an area or a wall
MOST_PAIRS = 100  # in one change
LONGEST_NAME = 100  # letters


def _at_most(most: int, what: str) -> AfterValidator:
    def check(given: Sequence[Any]) -> Sequence[Any]:
        if len(given) > most:
            raise ValueError(f"{len(given)} {what}, at most {most} are taken at once; make several changes")
        return given

    return AfterValidator(check)


class _Asked(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


Metres = Annotated[float, Field(allow_inf_nan=False)]
Point = tuple[Metres, Metres]  # x, y in the map
Number = Annotated[int, Field(ge=0, lt=2**53)]
Seconds = Annotated[float, Field(allow_inf_nan=False, ge=-1e9, le=1e9)]  # after the map's first key frame
Corners = Annotated[list[Point], _at_most(MOST_CORNERS, "points")]


class Look(_Asked):
    """Versions, pairs and key frames of the map as it is now."""


class LookAtKeyframe(_Asked):
    """The points that a key frame saw."""

    version: Number
    keyframe: Number


class Erase(_Asked):
    what: Literal["erase"]
    corners: Corners
    free: bool = False


class Wall(_Asked):
    what: Literal["wall"]
    corners: Corners


class Cut(_Asked):
    what: Literal["cut"]
    from_s: Seconds
    to_s: Seconds
    bridge: bool = False


class Pair(_Asked):
    """Two points of the map that are one place, and the key frames that saw them."""

    points: tuple[Point, Point]
    keyframes: tuple[Number, Number]


class AddPairs(_Asked):
    what: Literal["add-pair"]
    pairs: Annotated[list[Pair], Field(min_length=1), _at_most(MOST_PAIRS, "pairs")]


class RemovePair(_Asked):
    what: Literal["remove-pair"]
    pair: Number


class Optimize(_Asked):
    what: Literal["optimize"]


class Undo(_Asked):
    """to    number of the version to go back to; None: the one before the newest edit"""

    what: Literal["undo"]
    to: Number | None = None


ContentChange = Annotated[Erase | Wall | Cut | AddPairs | RemovePair | Optimize, Field(discriminator="what")]
ChangeAsked = Annotated[
    Erase | Wall | Cut | AddPairs | RemovePair | Optimize | Undo, Field(discriminator="what")
]


class Edit(_Asked):
    """One change. version: the one that the person saw; who: "" for the user of the command"""

    version: Number
    who: Annotated[str, Field(max_length=LONGEST_NAME)] = ""
    change: ChangeAsked


class KeyframeOfSession(_Asked):
    """The points that a key frame saw. seen: what SessionMapCommands gave for a look"""

    seen: str
    keyframe: Number


class EditOfCopy(_Asked):
    """One change. seen: as above; "" where nobody has looked, which suffices for areas and walls"""

    seen: str = ""
    who: Annotated[str, Field(max_length=LONGEST_NAME)] = ""
    change: ContentChange


Asked = Look | LookAtKeyframe | Edit
REQUESTS: dict[str, TypeAdapter[Any]] = {
    "map_look": TypeAdapter(Look),
    "map_keyframe": TypeAdapter(LookAtKeyframe),
    "map_edit": TypeAdapter(Edit),
}
VERBS = tuple(REQUESTS)


def read_asked(verb: str, payload: bytes) -> Asked:
    """What a page asks. Raises InputError, which names what is wrong."""
    if verb not in REQUESTS:
        raise InputError(f"this is a stored map; it knows {', '.join(VERBS)}")
    asked: Asked = read_as(REQUESTS[verb], payload)
    return asked


def read_as(kind: TypeAdapter[Any], payload: bytes) -> Any:
    """Raises InputError, which names what is wrong."""
    try:
        return kind.validate_json(payload)
    except ValidationError as error:
        fault = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(map(str, fault["loc"]))
        words = fault["msg"].removeprefix("Value error, ")
        raise InputError(f"{where}: {words}" if where else words) from error
