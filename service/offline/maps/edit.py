"""`corridor map edit`: changes of a stored map by a person. Each change is a new version; none is lost."""

import getpass
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from drivers.counted import counted
from service.errors import InputError, UsageError
from service.geometry.poses import Floats
from service.mapper.edit_requests import (
    Becomes,
    EditError,
    at_words,
    erased_words,
    moved_words,
    refuse_line,
    refuse_outline,
    wall_words,
)
from service.mapper.graph.edit.editing import (
    rendered_part,
    solved,
    with_area_erased,
    with_pair,
    with_wall,
    without_loops,
    without_pair,
    without_time,
)
from service.mapper.maps.occupancy import OccupancyConfig, OccupancyTiles
from service.mapper.saved_graph import SavedGraph
from service.mapstore.drawn_tiles import with_area, with_line
from service.mapstore.edits import Edit, undone_by
from service.mapstore.files import StoredMap, is_map_folder, load_map, restore_version, save_map, versions_of
from service.mapstore.in_use import InUse
from service.offline.replay.result import rewrite_result
from service.outputs import UNKNOWN

MIN_SHOWN_PERCENT, MAX_SHOWN_PERCENT = 3, 97  # at the limits of evidence of an OccupancyTiles
MAX_NAMED = 3  # positions of pairs in the text of an edit


@dataclass(frozen=True, slots=True)
class Changed:
    """A map after a change, and what the change did, for a person and for JSON."""

    stored: StoredMap
    words: str
    facts: dict[str, Any]


Change = Callable[[StoredMap], Changed]


class OvertakenError(InputError):
    """The map has changed since the version that the person saw."""


def edit_map(
    folder: Path, what: str, change: Change, who: str, now_ns: int, seen: int | None = None
) -> dict[str, Any]:
    """Make one change to the current version; a summary for JSON.

    what    name of the change;  now_ns  Unix time
    seen    number of the version that the person saw; None: whichever is current

    Raises InputError where the map cannot be read or the change cannot be made, OvertakenError where `seen`
    is not current any more, StorageError where the folder cannot be written or a session goes on in the map;
    then nothing is changed.
    """
    with _in_use(folder):
        before = load_map(folder)
        _refuse_if_overtaken(folder, before.number, seen)
        try:
            changed = change(before)
        except EditError as error:
            raise InputError(f"{folder}: {error}") from error
        stored = changed.stored
        edit = Edit(who, what, changed.words, before.number)
        number = save_map(folder, stored.tiles, now_ns, stored.about, stored.geo, stored.graph, edit)
        rewrite_result(folder)
    return {
        "map": str(folder),
        "version": number,
        "version_before": before.number,
        "done": changed.words,
        **changed.facts,
        "problems": before.problems,
    }


def undo(folder: Path, to: int | None, who: str, now_ns: int, seen: int | None = None) -> dict[str, Any]:
    """Make the version before the newest edit, or version `to`, the current one again; a summary for JSON.

    Raises InputError where there is nothing to go back to, OvertakenError and StorageError as edit_map.
    """
    with _in_use(folder):
        versions, current, _ = versions_of(folder)
        _refuse_if_overtaken(folder, current, seen)
        if to is None:
            undone, back_to = undone_by(versions, current)
            what = undone.edit.words if undone.edit is not None else ""
            words = f"took back version {undone.number} ({what}): as version {back_to} was"
        else:
            back_to, words = to, f"went back to version {to}"
        number = restore_version(folder, back_to, now_ns, Edit(who, "undo", words, current, back_to))
        rewrite_result(folder)
    return {"map": str(folder), "version": number, "version_before": current, "done": words}


def _in_use(folder: Path) -> InUse:
    """Raises InputError where `folder` has no map: nothing is written there then; StorageError as InUse."""
    if not is_map_folder(folder):
        load_map(folder)  # it gives the reason
    return InUse(folder, "corridor map edit")


def erase(corners: Sequence[float], becomes: Becomes = "as_seen") -> Change:
    """Erase an area from the shown map, and from the points that vehicles are localised against.

    becomes   what it is then. A map without a graph holds no beams: all is unknown there "as_seen"
    """
    outline = points_of(corners, least=3)
    _as_usage("map edit --erase", refuse_outline, outline)

    def change(stored: StoredMap) -> Changed:
        tiles, cells = with_area(stored.tiles, outline, MIN_SHOWN_PERCENT if becomes == "free" else UNKNOWN)
        graph, points = stored.graph, 0
        if graph is not None:
            graph, points = with_area_erased(graph, outline, becomes)
            if becomes == "as_seen":
                shown = OccupancyTiles(OccupancyConfig(), stored.cell_m)
                shown.replace_by(rendered_part(graph, outline, shown.renderer), ())
                tiles, cells = with_area(stored.tiles, outline, UNKNOWN, shown.changed_tiles())
        as_what = {"free": "free", "unknown": "unknown", "as_seen": "free or unknown, as scans see them,"}
        words = f"{erased_words(outline)}: {counted(cells, 'cell')} {as_what[becomes]} now"
        facts = {"cells_changed": cells, "points_gone": points}
        return Changed(
            replace(stored, tiles=tiles, graph=graph), f"{words}, {counted(points, 'point')} gone", facts
        )

    return change


def wall(corners: Sequence[float]) -> Change:
    """Add a wall that beams never clear."""
    line = points_of(corners, least=2)
    _as_usage("map edit --wall", refuse_line, line)

    def change(stored: StoredMap) -> Changed:
        tiles, cells = with_line(stored.tiles, line, MAX_SHOWN_PERCENT)
        graph = None if stored.graph is None else with_wall(stored.graph, line)
        return Changed(replace(stored, tiles=tiles, graph=graph), wall_words(line), {"cells_changed": cells})

    return change


def cut(from_to: Sequence[str], is_bridged: bool) -> Change:
    """Remove the key frames of a time span."""

    def change(stored: StoredMap) -> Changed:
        graph = _graph_of(stored)
        from_ns, to_ns = (stamp_of(text, int(graph.stamp_ns.min())) for text in from_to)
        less = without_time(graph, from_ns, to_ns, is_bridged)
        gone = len(graph) - len(less)
        loops = len(graph.loop_ends) - len(less.loop_ends)
        words = f"cut {counted(gone, 'key frame')} out, and {counted(loops, 'loop')} with them"
        return _solved(stored, less, words, {"keyframes_gone": gone, "loops_gone": loops})

    return change


def add_pairs(pairs: Sequence[tuple[Sequence[float], Sequence[int] | None]]) -> Change:
    """Several times two points of the map, X1 Y1 X2 Y2, are one place, and two key frames saw them; None:
    those that have them nearest. Solved once.
    """
    spots = [(points_of(points, least=2), keyframes) for points, keyframes in pairs]

    def change(stored: StoredMap) -> Changed:
        graph = _graph_of(stored)
        first = len(graph.by_hand.pair_ends)
        for points, keyframes in spots:
            graph = with_pair(graph, points, keyframes)
        added = [
            {"pair": first + k, "keyframes": ends}
            for k, ends in enumerate(graph.by_hand.pair_ends[first:].tolist())
        ]
        named = f"pair {first}" if len(spots) == 1 else f"pairs {first} to {first + len(spots) - 1}"
        about = ", ".join(at_words(points.mean(axis=0)) for points, _ in spots[:MAX_NAMED])
        words = f"{named} about {about}{' ...' * (len(spots) > MAX_NAMED)}"
        return _solved(stored, graph, words, {"added": added})

    return change


def remove_pair(number: int) -> Change:
    def change(stored: StoredMap) -> Changed:
        return _solved(stored, without_pair(_graph_of(stored), number), f"removed pair {number}", {})

    return change


def refuse_loops(numbers: Sequence[int]) -> Change:
    """Remove loops, by their numbers in `map loops`."""

    def change(stored: StoredMap) -> Changed:
        less = without_loops(_graph_of(stored), numbers)
        facts = ", ".join(map(str, numbers))
        return _solved(stored, less, f"took back loop{'s' * (len(numbers) > 1)} {facts}", {})

    return change


def optimize() -> Change:
    """Solve the graph and render the map again."""

    def change(stored: StoredMap) -> Changed:
        return _solved(stored, _graph_of(stored), "optimised", {})

    return change


def user_name() -> str:
    """Name of the user; "unknown" for one without a name, as in a container."""
    try:
        return getpass.getuser()
    except (OSError, KeyError):
        return "unknown"


def points_of(numbers: Sequence[float], least: int) -> Floats:
    """(C, 2) m. Raises UsageError where these are no points, or fewer than `least`."""
    if len(numbers) % 2 or len(numbers) < 2 * least or not all(map(math.isfinite, numbers)):
        raise UsageError(
            f"{' '.join(f'{n:g}' for n in numbers)}: expected X Y of {least} points or more, m in the map"
        )
    return np.array(numbers, np.float64).reshape(-1, 2)


def stamp_of(text: str, first_ns: int) -> int:
    """Unix ns of a time in UTC (2026-11-22T10:15:00Z), or of so many seconds after the map's first key frame.

    Raises UsageError.
    """
    try:
        return first_ns + round(float(text) * 1e9)
    except (ValueError, OverflowError):
        pass
    try:
        at = datetime.fromisoformat(text)
    except ValueError:
        raise UsageError(
            f"{text}: expected seconds after the map's first key frame, or a time as 2026-11-22T10:15:00Z"
        ) from None
    at = at if at.tzinfo is not None else at.replace(tzinfo=UTC)
    return int(at.timestamp()) * 10**9 + at.microsecond * 1000


def _solved(stored: StoredMap, graph: SavedGraph, words: str, facts: dict[str, Any]) -> Changed:
    shown = OccupancyTiles(OccupancyConfig(), stored.cell_m)
    done = solved(graph, shown.renderer)
    shown.replace_by(done.rendered_map, ())
    most_m = round(float(done.moved_m.max()), 3)
    return Changed(
        replace(stored, tiles=shown.changed_tiles(), graph=done.graph),
        moved_words(words, most_m, done.contradicted),
        {**facts, "moved_m": most_m, "loops_contradicted": done.contradicted},
    )


def _refuse_if_overtaken(folder: Path, current: int, seen: int | None) -> None:
    if seen is not None and seen != current:
        raise OvertakenError(
            f"{folder}: the map is at version {current}, and the change was meant for version {seen}; "
            "look at it again"
        )


def _graph_of(stored: StoredMap) -> SavedGraph:
    if stored.graph is None:
        raise EditError(
            "this map holds what was shown, not what it was made of; areas can be erased in it and walls "
            "drawn, and nothing else"
        )
    return stored.graph


def _as_usage(option: str, refuse: Callable[[Floats], None], points: Floats) -> None:
    """Raises UsageError where `refuse` does not take the points."""
    try:
        refuse(points)
    except EditError as error:
        raise UsageError(f"{option}: {error}") from error
