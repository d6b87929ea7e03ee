"""A stored map or the result of a replay in rerun: map, path by its stamps, pose graph."""

import subprocess
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from service.errors import CorridorError, StorageError, words_of
from service.extras import install_command
from service.mapstore.tiles import grid_of_tiles
from service.offline.past.result import open_result
from service.offline.past.view import graph_picture
from service.offline.score.trajectory import Trajectory
from service.outputs import GraphPicture, Grid

if TYPE_CHECKING:
    import rerun as rr

PATH_M, GRAPH_M = 0.03, 0.02  # radii of lines
PATH_Z_M, GRAPH_Z_M = 0.02, 0.04  # above the map, or they would flicker
PATH_COLOUR = (15, 118, 110)
KEYFRAMES_COLOUR, LOOP_COLOUR, REFUSED_COLOUR, BORDER_COLOUR = (
    (29, 78, 216),
    (21, 128, 61),
    (179, 38, 30),
    (109, 40, 217),
)


def show_in_rerun(source: Path, save: Path | None = None) -> None:
    """Open rerun's viewer, or write a recording of its own kind (.rrd) to `save`; returns at once.

    source   as of View

    Raises InputError where there is no map in it, CorridorError where rerun is not installed or does not
    start, StorageError where `save` cannot be written.
    """
    try:
        import rerun as rr
    except ImportError as error:
        raise CorridorError(
            f"--rerun needs rerun-sdk, which is not installed: {install_command('rerun')}"
        ) from error
    result = open_result(source)
    graph, trajectory = graph_picture(result), result.trajectory
    grid = grid_of_tiles(result.tiles)
    stream = rr.RecordingStream(f"corridor {source.resolve().name}")
    if save is not None:
        try:
            save.parent.mkdir(parents=True, exist_ok=True)
            save.open("wb").close()
        except OSError as error:
            raise StorageError(f"cannot write {save}: {words_of(error)}") from error
        stream.save(save)
    else:
        try:
            stream.spawn()
        except (RuntimeError, OSError, subprocess.SubprocessError) as error:
            raise CorridorError(f"the viewer of rerun does not start: {words_of(error)}") from error
    _log_map(stream, grid)
    _log_graph(stream, graph)
    if trajectory is not None:
        _log_path(stream, trajectory)
    stream.flush()
    stream.disconnect()


def _log_map(stream: "rr.RecordingStream", grid: Grid) -> None:
    import rerun as rr

    stream.log("map", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    height, width = grid.cells.shape
    picture = rr.GridMap(
        data=np.ascontiguousarray(grid.cells[::-1]).tobytes(),  # rows of an image go down
        format=rr.components.ImageFormat(width=width, height=height, color_model="L", channel_datatype="U8"),
        cell_size=grid.cell_m,
        translation=[grid.x_min_m, grid.y_min_m, 0.0],
        colormap=rr.components.Colormap.RvizMap,
    )
    stream.log("map/occupancy", picture, static=True)


def _log_graph(stream: "rr.RecordingStream", graph: GraphPicture) -> None:
    import rerun as rr

    closed = [np.concatenate((border, border[:1])) for border in graph.borders]
    for name, lines, colour in (
        ("key_frames", graph.paths, KEYFRAMES_COLOUR),
        ("loops", graph.accepted, LOOP_COLOUR),
        ("refused_loops", graph.refused, REFUSED_COLOUR),
        ("sub_maps", closed, BORDER_COLOUR),
    ):
        strips = [_raised(line, GRAPH_Z_M) for line in lines]
        if strips:
            strips_3d = rr.LineStrips3D(strips, radii=GRAPH_M, colors=[colour] * len(strips))
            stream.log(f"map/graph/{name}", strips_3d, static=True)


def _log_path(stream: "rr.RecordingStream", read: Trajectory) -> None:
    """The complete path, and the vehicle at each stamp."""
    import rerun as rr

    path = _raised(read.pose[:, :2].astype(np.float32), PATH_Z_M)
    stream.log("map/path", rr.LineStrips3D([path], radii=PATH_M, colors=[PATH_COLOUR]), static=True)
    ahead = np.column_stack((np.cos(read.pose[:, 2]), np.sin(read.pose[:, 2]), np.zeros(len(path))))
    stream.send_columns(
        "map/vehicle",
        indexes=[rr.TimeColumn("stamp", timestamp=read.stamp_ns.astype("datetime64[ns]"))],
        columns=rr.Arrows3D.columns(vectors=ahead.astype(np.float32), origins=path),
    )


def _raised(xy: npt.NDArray[np.float32], z_m: float) -> npt.NDArray[np.float32]:
    return np.column_stack((xy, np.full(len(xy), z_m, np.float32)))
