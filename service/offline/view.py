"""A stored map or the result of a replay on the operator's page: nothing is live, nothing is commanded."""

import math
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from service.encoding import OK, Status, encode_diagnostics, encode_graph
from service.errors import InputError, StorageError
from service.mapper.graph.graph_picture import draw, draw_saved
from service.mapstore.files import is_map_folder, load_map
from service.mapstore.ros_map import read_ros_map
from service.mapstore.tiles import TileStore
from service.offline.trajectory import read_tum
from service.outputs import NO_GRAPH, UNKNOWN, GraphPicture, Grid, TileUpdate
from service.publishing.commands import Answer, refusal
from service.web.access import new_token
from service.web.config import WebConfig
from service.web.server import About, WebServer

EDGE = 64  # cells along a tile
SERVED_WITHIN_S = 5.0


def open_view(source: Path, listen: str) -> WebServer:
    """Serve the page with what `source` holds; the caller closes it.

    source    the folder of a stored map, one that a replay wrote, or one with the map.yaml of a ROS map
    listen    as web.listen in a config

    Raises InputError where there is no map in it, StorageError where the page cannot be served.
    """
    (tiles, graph), path_map = read_stored(source), _path(source)
    store = TileStore()
    store.update(tiles)
    about = About(source.resolve().name, "stored", list)
    server = WebServer(WebConfig(listen=listen), about, store, _refuse, new_token())
    server.put_path(path_map)
    words = f"{source}: {len(tiles)} tiles, {len(path_map)} poses; nothing is measured"
    now_ns = time.time_ns()
    state = Status("mapping", OK, words, {"state": "stored"})
    server.put(encode_diagnostics("diagnostics", [state], now_ns, now_ns))
    server.put(encode_graph(graph, now_ns))
    start_serving(server)
    return server


def start_serving(server: WebServer) -> None:
    """Raises StorageError where the page cannot be served; the server is closed then."""
    server.start()
    if not server.wait_served(SERVED_WITHIN_S):
        words = server.health().message
        server.close()
        raise StorageError(f"{words}; give another address with --listen, 127.0.0.1:0 takes any free port")


def tiles_of_grid(grid: Grid) -> list[TileUpdate]:
    """A grid as tiles, its cells moved by less than half a cell to where those of tiles lie."""
    column, row = round(grid.x_min_m / grid.cell_m), round(grid.y_min_m / grid.cell_m)
    height, width = grid.cells.shape
    first_ix, first_iy = column // EDGE, row // EDGE
    columns, rows = math.ceil((column + width) / EDGE) - first_ix, math.ceil((row + height) / EDGE) - first_iy
    canvas = np.full((rows * EDGE, columns * EDGE), UNKNOWN, dtype=np.int8)
    low, left = row - first_iy * EDGE, column - first_ix * EDGE
    canvas[low : low + height, left : left + width] = grid.cells
    squares = canvas.reshape(rows, EDGE, columns, EDGE).swapaxes(1, 2)
    known = np.argwhere((squares != UNKNOWN).any(axis=(2, 3))).tolist()
    return [
        TileUpdate(0, first_ix + ix, first_iy + iy, version, grid.cell_m, squares[iy, ix])
        for version, (iy, ix) in enumerate(known, start=1)
    ]


def read_stored(source: Path) -> tuple[Sequence[TileUpdate], GraphPicture]:
    """Map and graph of what open_view takes. Raises InputError where there is no map in it."""
    for folder in (source, source / "map"):  # a replay stores its map in a folder of its own, where it can
        if is_map_folder(folder):
            stored = load_map(folder)
            return stored.tiles, NO_GRAPH if stored.graph is None else draw_saved(stored.graph)
    if not (source / "map.yaml").is_file():
        raise InputError(f"{source}: no map in it; give the folder of a stored map or of a replay's result")
    return tiles_of_grid(read_ros_map(source / "map.yaml")), _graph_of_g2o(source / "graph.g2o")


def _graph_of_g2o(path: Path) -> GraphPicture:
    """Poses along the way, and the edges that do not lead from one to the next: loops."""
    if not path.is_file():
        return NO_GRAPH
    places: dict[int, tuple[float, float]] = {}
    edges: list[tuple[int, int]] = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
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


def _path(source: Path) -> npt.NDArray[np.float32]:
    """(N, 2), m, map frame; none where there is no trajectory."""
    trajectory = source / "trajectory.tum"
    if not trajectory.is_file():
        return np.empty((0, 2), np.float32)
    return read_tum(trajectory).pose[:, :2].astype(np.float32)


def _refuse(verb: str, payload: bytes) -> Answer:
    return refusal("this is a stored map; there is no vehicle to command")
