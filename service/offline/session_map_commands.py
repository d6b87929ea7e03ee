"""Carries out what the operator's page asks of the map of a running session: a process of its own.

The session goes on extending its map while a person looks at it. So what is looked at is a version as it was
saved, held here; a change is made in a copy saved later, in which the mapping then goes on. Key frames of the
two are the same where their stamps are, and points of a person go with the key frames that saw them.

One request a line of stdin, its answer a line of stdout, both JSON: {"verb", "map", "request"} and
{"ok", "error" or what was asked for}. It ends with its stdin, or where nothing is asked for IDLE_S.
"""

import json
import os
import secrets
import select
import sys
import time
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from pydantic import TypeAdapter

from service.errors import CorridorError, InputError
from service.geometry import poses as se2
from service.mapper.saved_graph import SavedGraph
from service.mapstore.files import StoredMap, load_map
from service.offline import map_edit
from service.offline.map_asked import (
    AddPairs,
    Cut,
    EditOfCopy,
    Erase,
    KeyframeOfSession,
    Pair,
    RemovePair,
    Wall,
    read_as,
)
from service.offline.map_commands import as_edit, look, look_at_keyframe

IDLE_S = 900.0  # then the memory of the map is given back; the page looks again
PAIR_WITHIN_M = 1e-6  # points of one pair in two versions, in the frames of its key frames

NO_KEYFRAMES = (
    "this map holds no key frames: its profile makes none, or the vehicle is not found in it yet; "
    "areas can be erased and walls drawn"
)

_KEYFRAME, _EDIT = TypeAdapter[Any](KeyframeOfSession), TypeAdapter[Any](EditOfCopy)


class SessionMapCommands:
    """One request after the other. Holds what was looked at last."""

    def __init__(self) -> None:
        self._seen: StoredMap | None = None
        self._name = ""  # of that look, unlike that of any other

    def answer(self, line: bytes) -> dict[str, Any]:
        """What becomes of a request; what cannot be done is said in words."""
        asked = json.loads(line)
        folder = Path(asked["map"])
        try:
            return {
                "ok": True,
                **self._carry_out(asked["verb"], folder, json.dumps(asked["request"]).encode()),
            }
        except CorridorError as error:
            return {"ok": False, "error": str(error).removeprefix(f"{folder}: ")}

    def _carry_out(self, verb: str, folder: Path, request: bytes) -> dict[str, Any]:
        match verb:
            case "look":
                self._seen, self._name = load_map(folder), secrets.token_hex(8)
                return {**look(self._seen), "seen": self._name, "user": map_edit.user_name()}
            case "keyframe":
                wanted: KeyframeOfSession = read_as(_KEYFRAME, request)
                return look_at_keyframe(self._looked_at(wanted.seen), wanted.keyframe)
            case "edit":
                return self._edit(folder, read_as(_EDIT, request))
        raise InputError(f"{verb}: look, keyframe and edit are known")

    def _edit(self, folder: Path, asked: EditOfCopy) -> dict[str, Any]:
        change, stored = asked.change, load_map(folder)
        if not isinstance(change, Erase | Wall):
            _graph(stored)
        if isinstance(change, AddPairs | Cut | RemovePair):
            change = moved_on(change, _graph(self._looked_at(asked.seen)), _graph(stored))
        who = asked.who.strip() or map_edit.user_name()
        edit = as_edit(change)
        done = map_edit.edit_map(folder, change.what, edit, who, time.time_ns(), stored.number)
        return {"done": done["done"]}

    def _looked_at(self, name: str) -> StoredMap:
        if self._seen is None or name != self._name:
            raise InputError("another page has fetched key frames since, or it is long ago; fetch them again")
        return self._seen


def moved_on(
    change: AddPairs | Cut | RemovePair, seen: SavedGraph, now: SavedGraph
) -> AddPairs | Cut | RemovePair:
    """What a person asked for in view of one graph, as it is in a later one. Raises InputError."""
    match change:
        case AddPairs():
            return AddPairs(what="add-pair", pairs=[_pair_moved_on(pair, seen, now) for pair in change.pairs])
        case Cut():
            later_s = float(seen.stamp_ns.min() - now.stamp_ns.min()) / 1e9
            return Cut(
                what="cut",
                from_s=change.from_s + later_s,
                to_s=change.to_s + later_s,
                bridge=change.bridge,
            )
        case RemovePair():
            return RemovePair(what="remove-pair", pair=_pair_number(change.pair, seen, now))


def _pair_moved_on(pair: Pair, seen: SavedGraph, now: SavedGraph) -> Pair:
    of_first, of_second = pair.keyframes
    keyframes = _keyframe(of_first, seen, now), _keyframe(of_second, seen, now)
    xy_base = se2.points_seen(seen.map[list(pair.keyframes)], np.array(pair.points))
    (x, y), (other_x, other_y) = se2.points_from(now.map[list(keyframes)], xy_base).tolist()
    return Pair(points=((x, y), (other_x, other_y)), keyframes=keyframes)


def _keyframe(k: int, seen: SavedGraph, now: SavedGraph) -> int:
    """Its number in the later graph."""
    found = np.flatnonzero(now.stamp_ns == seen.stamp_ns[k]).tolist() if k < len(seen) else []
    if len(found) != 1:
        raise InputError(f"key frame {k} is not in the map any more; fetch the key frames again")
    return int(found[0])


def _pair_number(number: int, seen: SavedGraph, now: SavedGraph) -> int:
    """Of the same pair in the later graph."""
    if number < len(seen.by_hand.pair_ends):
        ends = [_keyframe(k, seen, now) for k in seen.by_hand.pair_ends[number].tolist()]
        is_it = (now.by_hand.pair_ends == ends).all(axis=1)
        off_m = abs(now.by_hand.pair_xy - seen.by_hand.pair_xy[number]).max(axis=(1, 2), initial=0.0)
        if (found := np.flatnonzero(is_it & (off_m < PAIR_WITHIN_M))).size:
            return int(found[0])
    raise InputError(f"there is no pair {number} in the map any more; fetch the key frames again")


def _graph(stored: StoredMap) -> SavedGraph:
    if stored.graph is None:
        raise InputError(NO_KEYFRAMES)
    return stored.graph


def serve(requests: BinaryIO, answers: BinaryIO) -> None:
    """Until `requests` ends, or brings nothing for IDLE_S."""
    commands = SessionMapCommands()
    while select.select([requests], [], [], IDLE_S)[0] and (line := requests.readline()):
        answers.write(json.dumps(commands.answer(line)).encode() + b"\n")
        answers.flush()


if __name__ == "__main__":
    told = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # nothing else comes between the answers
    serve(sys.stdin.buffer, told)
