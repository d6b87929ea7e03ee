"""Executes requests of the operator's page on a stored map, by the same code as `corridor map edit`."""

import base64
import json
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from service.errors import CorridorError, InputError
from service.geometry import poses as se2
from service.mapper import edit_requests as edits
from service.mapper.by_hand import pairs_of
from service.mapper.saved_graph import SavedGraph
from service.mapstore.files import StoredMap, load_map
from service.offline.maps import edit as map_edit
from service.offline.maps import requests as requested_by
from service.offline.maps.disagreeing_passes import disagreeing_passes
from service.offline.maps.loops import as_pairs, loops_of
from service.offline.maps.work import map_log
from service.publishing.commands import Answer, refusal
from service.web.protocol import encode_tiles

MAX_KEYFRAMES = 20_000  # reported to a page; then every second, third ... is left out
MAX_VERSIONS = 50


class MapCommands:
    """The commands of one stored map, from any thread; one change at a time.

    stored    what the folder holds now
    show      called with each newer version of it, by the thread that made or found it
    """

    def __init__(self, folder: Path, stored: StoredMap, show: Callable[[StoredMap], None]) -> None:
        self._folder = folder
        self._stored = stored
        self._show = show
        self._changing = threading.Lock()
        self._user = map_edit.user_name()
        self.table: requested_by.Table = {
            "map_look": (requested_by.Look, lambda _: self._look()),
            "map_keyframe": (requested_by.LookAtKeyframe, self._keyframe),
            "map_version": (requested_by.LookAtVersion, self._version),
            "map_edit": (requested_by.Edit, self._edit),
        }

    def answer(self, verb: str, payload: bytes) -> Answer:
        """JSON in, JSON out; what cannot be done is answered with the reason."""
        try:
            facts = requested_by.carry_out(self.table, verb, payload)
        except CorridorError as error:
            return refusal(str(error).removeprefix(f"{self._folder}: "))  # the page shows one map
        return Answer(True, json.dumps({"ok": True, **facts}).encode())

    def _look(self) -> dict[str, Any]:
        log = map_log(self._folder)
        versions = {"versions": log["versions"][-MAX_VERSIONS:], "problems": log["problems"]}
        return {**look(self._stored), **versions, "loops": _loops(self._stored.graph), "user": self._user}

    def _keyframe(self, requested: requested_by.LookAtKeyframe) -> dict[str, Any]:
        stored = self._stored
        if requested.version != stored.number:
            raise InputError(
                f"the map is at version {stored.number}, and this is of version {requested.version}; "
                "look at it again"
            )
        return look_at_keyframe(stored, requested.keyframe)

    def _version(self, requested: requested_by.LookAtVersion) -> dict[str, Any]:
        """Its tiles as a message of service.web.protocol, base64."""
        tiles = load_map(self._folder, requested.version).tiles
        if not tiles:
            raise InputError(
                f"version {requested.version} of the map has no tiles; there is nothing to compare"
            )
        return {"version": requested.version, "tiles": base64.b64encode(encode_tiles(tiles)).decode()}

    def _edit(self, requested: requested_by.Edit) -> dict[str, Any]:
        if not self._changing.acquire(blocking=False):
            raise InputError("another change of this map is being made; wait until it is done")
        who, now_ns = requested.who.strip() or self._user, time.time_ns()
        change = requested.change
        try:
            if isinstance(change, requested_by.UndoTo):
                facts = map_edit.undo(self._folder, change.to, who, now_ns, requested.version)
            else:
                edit = as_edit(change)
                facts = map_edit.edit_map(self._folder, change.what, edit, who, now_ns, requested.version)
            self._take(load_map(self._folder))
            return facts
        except map_edit.OvertakenError:
            self._take(load_map(self._folder))
            raise
        finally:
            self._changing.release()

    def _take(self, stored: StoredMap) -> None:
        self._stored = stored
        self._show(stored)


def look(stored: StoredMap) -> dict[str, Any]:
    """A version for the page: its number, pairs, passes that could be joined, and key frames."""
    graph = stored.graph
    return {
        "version": stored.number,
        "pairs": [] if graph is None else pairs_of(graph.by_hand, graph.map),
        "passes": [] if graph is None else disagreeing_passes(graph),
        "keyframes": None if graph is None else _keyframes(graph),
    }


def look_at_keyframe(stored: StoredMap, k: int) -> dict[str, Any]:
    """Its pose and its points in the map; its stamp in digits, for JavaScript cannot represent such integers.

    Raises InputError where there is none.
    """
    graph = stored.graph
    if graph is None or k >= len(graph):
        raise InputError(f"there is no key frame {k} in this map")
    points = se2.points_from(graph.map[k], graph.points_of(k))
    return {
        "keyframe": k,
        "stamp_ns": str(graph.stamp_ns[k]),
        "pose": graph.map[k].tolist(),
        "points": np.round(points, 4).ravel().tolist(),
    }


def _loops(graph: SavedGraph | None) -> dict[str, Any]:
    """Loops as in `map loops`; of each refused one the pairs by which it would be accepted, without those
    that a person has accepted so.
    """
    if graph is None:
        return {"accepted": [], "refused": []}
    accepted, refused = loops_of(graph)
    pairs = as_pairs(graph, graph.refused.ends, graph.refused.measured)
    is_joined = graph.by_hand.pairs(graph.refused.ends)
    return {
        "accepted": accepted,
        "refused": [
            {**loop, "pairs": points}
            for loop, points, is_accepted in zip(refused, pairs, is_joined, strict=True)
            if not is_accepted
        ],
    }


def as_edit(change: requested_by.ChangeRequest) -> map_edit.Change:
    match change:
        case edits.Erase():
            return map_edit.erase(np.ravel(change.corners).tolist(), change.becomes)
        case edits.Wall():
            return map_edit.wall(np.ravel(change.corners).tolist())
        case edits.Cut():
            return map_edit.cut((repr(change.from_s), repr(change.to_s)), change.bridge)
        case edits.AddPairs():
            pairs = [(np.ravel(pair.points).tolist(), pair.keyframes) for pair in change.pairs]
            return map_edit.add_pairs(pairs)
        case requested_by.RefuseLoop():
            return map_edit.refuse_loops([change.loop])
        case edits.RemovePair():
            return map_edit.remove_pair(change.pair)
        case edits.Optimize():
            return map_edit.optimize()
        case requested_by.UndoTo():
            raise TypeError("an undo is no change of what the map holds")


def _keyframes(graph: SavedGraph) -> dict[str, Any]:
    """Poses and times by rising number, of each `every`-th key frame."""
    every = -(-len(graph) // MAX_KEYFRAMES) or 1
    seconds = (graph.stamp_ns - graph.stamp_ns.min()) / 1e9 if len(graph) else np.zeros(0)
    return {
        "count": len(graph),
        "every": every,
        "x_m": np.round(graph.map[::every, 0], 3).tolist(),
        "y_m": np.round(graph.map[::every, 1], 3).tolist(),
        "at_s": np.round(seconds[::every], 3).tolist(),
    }
