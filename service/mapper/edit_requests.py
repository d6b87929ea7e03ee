"""Requests that change a map manually, as JSON models with bounds."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, Any, Generic, Literal, TypeVar

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, TypeAdapter

from drivers.counted import counted
from service.geometry.polygons import area_m2
from service.geometry.poses import Floats

MAX_CORNERS = 500  # of an area or a wall
MAX_PAIRS = 100  # in one change
MAX_NAME_LENGTH = 100  # characters
LARGEST_M2 = 10_000.0  # of the bounding box of an area or of a line of a wall: 4 million cells of 5 cm
MIN_M2 = 1e-4  # of an area
MAX_COORDINATE_M = 100_000.0  # from the origin
ONLY_LOCALISED = "the map stays as it is while the vehicle is only localised"


class EditError(ValueError):
    """A change is refused; the message gives the reason."""


def at_most(most: int, what: str) -> AfterValidator:
    def check(given: Sequence[Any]) -> Sequence[Any]:
        if len(given) > most:
            raise ValueError(f"{len(given)} {what}, at most {most} are taken at once; make several changes")
        return given

    return AfterValidator(check)


class RequestModel(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


Metres = Annotated[float, Field(allow_inf_nan=False)]
Point = tuple[Metres, Metres]  # x, y in the map
Number = Annotated[int, Field(ge=0, lt=2**53)]
Stamp = Annotated[str, Field(pattern=r"^\d{1,19}$")]
Seconds = Annotated[float, Field(allow_inf_nan=False, ge=-1e9, le=1e9)]  # after the map's first key frame
Corners = Annotated[list[Point], at_most(MAX_CORNERS, "points")]
Who = Annotated[str, Field(max_length=MAX_NAME_LENGTH)]
PairT = TypeVar("PairT", bound=RequestModel)
Becomes = Literal["as_seen", "unknown", "free"]  # as_seen: free where beams pass, else unknown


class Erase(RequestModel):
    """becomes: state of the area afterwards"""

    what: Literal["erase"]
    corners: Corners
    becomes: Becomes = "as_seen"


class Wall(RequestModel):
    what: Literal["wall"]
    corners: Corners


class Cut(RequestModel):
    what: Literal["cut"]
    from_s: Seconds
    to_s: Seconds
    bridge: bool = False


class RemovePair(RequestModel):
    what: Literal["remove-pair"]
    pair: Number


class Optimize(RequestModel):
    what: Literal["optimize"]


class SeenPair(RequestModel):
    """Two points that are one place, in the base frames of the key frames that saw them.

    stamps_ns   of these key frames, as digits: JavaScript integers end at 2^53
    """

    stamps_ns: tuple[Stamp, Stamp]
    points_base: tuple[Point, Point]


class AddPairs(RequestModel, Generic[PairT]):
    what: Literal["add-pair"]
    pairs: Annotated[list[PairT], Field(min_length=1), at_most(MAX_PAIRS, "pairs")]


class SeenLoop(RequestModel):
    """stamps_ns   of the key frames of a loop, the earlier pass first, as digits"""

    stamps_ns: tuple[Stamp, Stamp]


class RefuseSeenLoop(SeenLoop):
    what: Literal["refuse-loop"]


class AcceptSeenLoop(SeenLoop):
    what: Literal["accept-loop"]


class Undo(RequestModel):
    what: Literal["undo"]


LoopChange = RefuseSeenLoop | AcceptSeenLoop
LiveChange = Erase | Wall | Cut | AddPairs[SeenPair] | RemovePair | LoopChange | Optimize | Undo


class EditMap(RequestModel):
    """One change of the map that is being made. who: name for the recording"""

    who: Who = ""
    change: Annotated[LiveChange, Field(discriminator="what")]


EDIT_MAP: TypeAdapter[EditMap] = TypeAdapter(EditMap)


def refuse_outline(corners: Floats) -> None:
    """Raises EditError if (C, 2) m are no outline of an area, or too large a one."""
    if len(corners) < 3:
        raise EditError(f"an area has 3 corners or more, not {len(corners)}")
    _refuse_if_large(corners, "the area", "erase it in parts")
    if area_m2(corners) < MIN_M2:
        raise EditError("the corners X Y X Y X Y... enclose no area")


def refuse_line(corners: Floats) -> None:
    """Raises EditError if (C, 2) m are no wall, or too large a one."""
    if len(corners) < 2:
        raise EditError(f"a wall goes through 2 points or more, not {len(corners)}")
    for segment in pairwise(corners):
        _refuse_if_large(np.array(segment), "a part of the wall", "draw it through more points")
    if not np.ptp(corners, axis=0).any():
        raise EditError(f"all {len(corners)} points of the wall are {at_words(corners[0])}; it has no length")


def _refuse_if_large(points: Floats, what: str, instead: str) -> None:
    """Raises EditError if the bounding box of (C, 2) m has too many cells to search."""
    if (most_m := float(np.abs(points).max())) > MAX_COORDINATE_M:
        raise EditError(
            f"{what} reaches {most_m:.6g} m from the origin; at most {MAX_COORDINATE_M:.0f} m are taken"
        )
    width_m, height_m = np.ptp(points, axis=0).tolist()
    if width_m * height_m > LARGEST_M2:
        raise EditError(
            f"{what} spans {width_m:.0f} m x {height_m:.0f} m, more than {LARGEST_M2:.0f} m2; {instead}"
        )


def at_words(xy: Floats) -> str:
    """Text for a point (2,) m of the map."""
    return f"({xy[0]:.2f}, {xy[1]:.2f}) m"


def erased_words(corners: Floats) -> str:
    return f"erased {area_m2(corners):.2f} m2 about {at_words(corners.mean(axis=0))}"


def wall_words(corners: Floats) -> str:
    length_m = float(np.hypot(*np.diff(corners, axis=0).T).sum())
    return f"drew a wall of {length_m:.2f} m about {at_words(corners.mean(axis=0))}"


def moved_words(words: str, most_m: float, contradicted: int) -> str:
    """Text for a change after which the graph was solved. contradicted: number of dropped loops"""
    aside = f"; gone as the rest contradicts: {counted(contradicted, 'loop')}" if contradicted else ""
    return f"{words}; key frames moved by up to {most_m:.3f} m{aside}"
