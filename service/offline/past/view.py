"""A stored map or the result of a replay on the operator's page: nothing is live; a map can be edited."""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from drivers.counted import counted
from service.encoding import CHANGES, OK, Status, encode_diagnostics, encode_graph
from service.errors import InputError
from service.mapper.graph.model.graph_picture import draw, draw_saved
from service.mapper.map_changes import MapChanges
from service.mapstore.files import StoredMap
from service.offline.maps.change_file import CHANGES_FILE, read_changes
from service.offline.maps.changed_places import read_changed_places
from service.offline.maps.commands import MapCommands
from service.offline.maps.requests import Table
from service.offline.past.driven_moments import DrivenMoments
from service.offline.past.past_page import PastPage
from service.offline.past.result import GRAPH_FILE, Result, map_folder, open_result
from service.offline.score.trajectory import Trajectory
from service.outputs import NO_GRAPH, GraphPicture, TileUpdate
from service.publishing.commands import Answer
from service.readable import read_text
from service.web.protocol import encode_changes, encode_path, series_json
from service.web.send_queue import Payload
from service.web.server import start_serving

NO_TRAJECTORY = Trajectory(np.empty(0, np.int64), np.empty((0, 3)))


class View(PastPage):
    """A page that shows one stored map or result, and what becomes of it, until `close`.

    source    the folder of a stored map, one that a replay wrote, or one with the map.yaml of a ROS map
    listen    as web.listen in a config

    Raises InputError where there is no map in it, StorageError where the page cannot be served.
    """

    what = "this cannot be changed, as the folder of a stored map can"

    def __init__(self, source: Path, listen: str) -> None:
        self._source = source
        self._result = result = open_result(source)
        self._at_ns: int | None = None  # of the moment that is shown
        self._map_commands: MapCommands | None = None
        if (folder := map_folder(source)) is not None and result.stored is not None:
            self._map_commands = MapCommands(folder, result.stored, self._show_stored)
        super().__init__(source.resolve().name, "stored", listen)
        self._show(result)
        start_serving(self.server)

    def commands(self) -> Table:
        return {**(self._map_commands.table if self._map_commands is not None else {}), **super().commands()}

    def answer(self, verb: str, payload: bytes) -> Answer:
        if self._map_commands is not None and verb in self._map_commands.table:
            return self._map_commands.answer(verb, payload)
        return super().answer(verb, payload)

    def show_moment(self, at_ns: int, payloads: Mapping[str, Payload]) -> None:
        self._at_ns = at_ns
        super().show_moment(at_ns, payloads)

    def _show_stored(self, stored: StoredMap) -> None:
        self._result = replace(self._result, stored=stored)
        self._show(self._result)

    def _show(self, result: Result) -> None:
        now_ns = time.time_ns()
        tiles, trajectory = result.tiles, result.trajectory or NO_TRAJECTORY
        self.tiles.take(tiles)
        self._show_path(trajectory)
        self.server.put(encode_graph(graph_picture(result), now_ns))
        facts = {} if result.stored is None else {"version": str(result.stored.number)}
        if (geo := result.geo) is not None:
            facts["map_yaw_enu_deg"] = f"{math.degrees(geo.pose_enu_map.theta_rad):.2f}"
        version = f" of version {facts['version']}" if result.stored is not None else ""
        words = (
            f"{self._source}: {counted(len(tiles), 'tile')}{version}, "
            f"{counted(len(trajectory.pose), 'pose')}; nothing is measured"
        )
        state = Status("mapping", OK, words, {"state": "stored", **facts})
        self.server.put(encode_diagnostics("diagnostics", [state], now_ns, now_ns))
        if (changes := self._changes(result, tiles)) is not None:
            self.server.put_ready({CHANGES: encode_changes(changes.as_grid())})

    def _changes(self, result: Result, tiles: Sequence[TileUpdate]) -> MapChanges | None:
        """Changes of a site from session to session; of a drive that was localised in a stored map what
        differs from it.
        """
        if result.stored is not None:
            changed = read_changed_places(self._source, result.stored.number)
            return None if changed is None else changed.as_map_changes()
        return read_changes(self._source / CHANGES_FILE, tiles[0].cell_m) if tiles else None

    def _show_path(self, driven: Trajectory) -> None:
        """The complete path, and of its moments the one that was shown before; at first the last."""
        if not len(driven.stamp_ns):
            self.moments = None
            path = encode_path(np.empty((0, 2), np.float32))
            self.server.put_ready({"path": path, "series": series_json((), events=())})
            return
        moments = DrivenMoments(driven.stamp_ns, driven.pose)
        self.server.put_ready({"series": series_json(moments.rows, events=())})
        self.look_back(moments, self._at_ns)


def graph_picture(result: Result) -> GraphPicture:
    """Raises InputError where its file is damaged."""
    if result.stored is None:
        return _graph_of_g2o(result.source / GRAPH_FILE)
    return NO_GRAPH if result.stored.graph is None else draw_saved(result.stored.graph)


def _graph_of_g2o(path: Path) -> GraphPicture:
    """Poses along the path, and the edges that do not lead from one to the next: loops."""
    if not path.is_file():
        return NO_GRAPH
    places: dict[int, tuple[float, float]] = {}
    edges: list[tuple[int, int]] = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        try:
            match line.split():
                case ["VERTEX_SE2", k, x_m, y_m, *_]:
                    places[int(k)] = float(x_m), float(y_m)
                case ["EDGE_SE2", of, to, *_] if abs(int(of) - int(to)) != 1:
                    edges.append((int(of), int(to)))
        except ValueError as error:
            raise InputError(f"{path}:{number}: {line[:60]!r} is no line of a g2o file") from error
    row = {k: row for row, k in enumerate(sorted(places))}
    ends = [(row[of], row[to]) for of, to in edges if of in row and to in row]
    xy_map = np.array([places[k] for k in row]).reshape(-1, 2)
    none = np.empty((0, 2), np.int64)
    return draw(0, xy_map, np.zeros(len(row), np.int64), np.array(ends, np.int64).reshape(-1, 2), none)
