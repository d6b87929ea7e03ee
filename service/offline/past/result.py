"""A result of a replay, a stored map or a ROS map, in its newest version.

A replay stores its map as version 1 of DIR/map. A later version, made by an edit or by a session that extends
the map, has its own tiles and graph; its trajectory is that of the drive, bent to where the key frames are.
The files as the replay wrote them are in DIR, and in DIR/unedited once an edit has rewritten those in DIR.
"""

import json
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from service.errors import InputError, words_of
from service.geometry.geo_reference import GeoReference
from service.geometry.poses import Floats
from service.mapper.corrections import bent
from service.mapper.saved_graph import SavedGraph
from service.mapstore.files import StoredMap, is_map_folder, load_map
from service.mapstore.geo_file import GEO_FILE, read_geo
from service.mapstore.picture import Picture, picture_of_grid, picture_of_tiles
from service.mapstore.ros_map import read_ros_map
from service.mapstore.tiles import tiles_of_grid
from service.offline.score.trajectory import Trajectory, read_tum
from service.outputs import Grid, TileUpdate
from service.readable import read_text

log = logging.getLogger(__name__)

MAP_FOLDER, UNEDITED = "map", "unedited"
TRAJECTORY_FILE, GRAPH_FILE, SUMMARY_FILE, ROS_MAP_FILE = (
    "trajectory.tum", "graph.g2o", "summary.json", "map.yaml"
)  # fmt: skip
DONE_FILE = "done.json"  # of a task (service.offline.cluster); written last: a folder that has it is complete
FIRST_VERSION = 1  # of the map, which the replay stored


def map_folder(source: Path) -> Path | None:
    """The stored map that a folder is, or that a replay stored below it. None: there is none."""
    return next((folder for folder in (source, source / MAP_FOLDER) if is_map_folder(folder)), None)


def is_ros_map(source: Path) -> bool:
    """Whether it is the YAML of a ROS map, by its name."""
    return source.suffix in (".yaml", ".yml") and source.is_file()


def open_result(source: Path) -> "Result":
    """`source` is the folder of a replay's result or of a stored map, or a ROS map: its YAML, or the folder
    of a map.yaml.

    Raises InputError where the stored map in it is damaged.
    """
    folder = map_folder(source)
    return Result(source, None if folder is None else load_map(folder), Drive(source))


def read_trajectory(path: Path) -> Trajectory:
    """Trajectory of a TUM file, or of a result's newest version. Raises InputError."""
    if not path.is_dir():
        return read_tum(path)
    if (trajectory := open_result(path).trajectory) is None:
        raise InputError(
            f"{path}: no {TRAJECTORY_FILE} in it; give the folder of a replay's result, or a file"
        )
    return trajectory


class Drive:
    """Files of a replay before any edit. Each is read once, when it is requested."""

    def __init__(self, out: Path) -> None:
        self._out = out

    @cached_property
    def trajectory(self) -> Trajectory | None:
        path = self._file(TRAJECTORY_FILE)
        return read_tum(path) if path.is_file() else None

    @cached_property
    def g2o(self) -> str | None:
        path = self._file(GRAPH_FILE)
        try:
            return read_text(path, "ascii") if path.is_file() else None
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"{path}: {words_of(error)}") from error

    @cached_property
    def summary(self) -> dict[str, Any]:
        """{} where there is none."""
        path = self._file(SUMMARY_FILE)
        try:
            summary = json.loads(read_text(path)) if path.is_file() else {}
        except (OSError, ValueError, RecursionError) as error:
            raise InputError(f"{path}: {words_of(error)}") from error
        if not isinstance(summary, dict):
            raise InputError(f"{path}: expected a JSON object")
        return summary

    @cached_property
    def graph(self) -> SavedGraph | None:
        """The graph of the drive. None, with a warning, where its version is gone or damaged."""
        folder = self._out / MAP_FOLDER
        try:
            return load_map(folder, FIRST_VERSION).graph
        except InputError as error:
            log.warning("%s; the trajectory is as the replay wrote it, not as the map is now", error)
            return None

    def _file(self, name: str) -> Path:
        unedited = self._out / UNEDITED / name
        return unedited if unedited.is_file() else self._out / name


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """One version of a result. Its properties raise InputError where a file is damaged.

    stored   of its map; None: the result has no stored map, and its files are all there is
    """

    source: Path
    stored: StoredMap | None
    drive: Drive

    @property
    def has_trajectory(self) -> bool:
        return (self.source / TRAJECTORY_FILE).is_file()

    @property
    def has_map(self) -> bool:
        return self.stored is not None or self._ros_map_path.is_file()

    @property
    def geo(self) -> GeoReference | None:
        """Geo-reference of the map; None: not known."""
        if self.stored is not None:
            return self.stored.geo
        path = self.source / GEO_FILE
        return read_geo(path) if path.is_file() else None

    @property
    def picture(self) -> Picture:
        """Picture of the map. Raises InputError where there is none."""
        if self.stored is not None:
            return picture_of_tiles(self.stored.tiles)
        return picture_of_grid(self._ros_map())

    @property
    def tiles(self) -> Sequence[TileUpdate]:
        """Tiles of the map; those of a ROS map are off by at most half a cell. Raises as `picture`."""
        return self.stored.tiles if self.stored is not None else tiles_of_grid(self._ros_map())

    @property
    def trajectory(self) -> Trajectory | None:
        driven, moved = self.drive.trajectory, self._moved_graph
        if driven is None or moved is None or self.drive.graph is None:
            return driven
        return Trajectory(*corrected_path(driven.stamp_ns, driven.pose, self.drive.graph, moved))

    @property
    def g2o(self) -> str | None:
        """The graph as g2o text; None: there is none."""
        moved = self._moved_graph
        return self.drive.g2o if moved is None else _g2o_of(moved)

    @property
    def summary(self) -> dict[str, Any]:
        """summary.json, its figures of the map as they are now; {} where there is none."""
        summary, stored, moved = self.drive.summary, self.stored, self._moved_graph
        if summary and stored is not None and stored.number != FIRST_VERSION:
            summary = summary | {"map_version": stored.number, "map_tiles": len(stored.tiles)}
            if moved is not None:
                summary |= {"keyframes": len(moved), "loop_closures": len(moved.loop_ends)}
        return summary

    @property
    def _moved_graph(self) -> SavedGraph | None:
        """The graph of this version; None: it is that of the drive, or there is none."""
        if self.stored is None or (graph := self.stored.graph) is None:
            return None
        if not self.has_trajectory:
            return graph  # of a stored map by itself
        if self.stored.number == FIRST_VERSION:
            return None
        first = self.drive.graph
        return None if first is not None and _is_same(graph, first) else graph

    def _ros_map(self) -> Grid:
        if not self.has_map:
            raise InputError(
                f"{self.source}: no map in it; give the folder of a stored map or of a replay's result"
            )
        return read_ros_map(self._ros_map_path)

    @property
    def _ros_map_path(self) -> Path:
        return self.source if is_ros_map(self.source) else self.source / ROS_MAP_FILE


def _is_same(graph: SavedGraph, other: SavedGraph) -> bool:
    """Whether two graphs are one in their key frames and in what was measured between these."""
    names = ("stamp_ns", "map", "loop_measured")
    pairs = [(getattr(graph, name), getattr(other, name)) for name in names]
    return all(np.array_equal(*pair) for pair in (*pairs, (graph.by_hand.pair_xy, other.by_hand.pair_xy)))


def _g2o_of(graph: SavedGraph) -> str:
    # Imported here: the back end brings the mapper's kernels, which no other reader of a result needs.
    from service.mapper.graph.edit.editing import graph_of
    from service.mapper.graph.model.pose_graph import to_g2o

    return to_g2o(graph_of(graph))


def corrected_path(
    stamp_ns: npt.NDArray[np.int64], poses: Floats, before: SavedGraph, after: SavedGraph
) -> tuple[npt.NDArray[np.int64], Floats]:
    """(M,) and (M, 3): the path bent to where the key frames are now, as a replay bends it. The poses that
    followed a key frame which was cut out are gone.

    stamp_ns, poses   (N,) and (N, 3) of the trajectory, in the map of `before`
    """
    if not len(stamp_ns) or not len(before):
        return stamp_ns, poses
    # Two key frames of one moment: the last of each, for those of a map that the drive began in stand first.
    at_ns, from_end = np.unique(before.stamp_ns[::-1], return_index=True)
    row = len(before) - 1 - from_end
    _, kept, from_end = np.intersect1d(at_ns, after.stamp_ns[::-1], return_indices=True)
    now = np.full(len(at_ns), -1)
    now[kept] = len(after) - 1 - from_end
    is_kept = now >= 0
    at = np.maximum(np.searchsorted(at_ns, stamp_ns, side="right") - 1, 0)
    is_left = is_kept[at]
    at, stamp_ns = at[is_left], stamp_ns[is_left]
    # What is left before a cut goes with the key frame before it alone.
    ends_at_cut = ~is_kept[np.minimum(at + 1, len(at_ns) - 1)]
    weighed_ns = np.where(ends_at_cut, at_ns[at], stamp_ns)
    moved = bent(
        weighed_ns, poses[is_left], at_ns[is_kept], before.map[row[is_kept]], after.map[now[is_kept]]
    )
    return stamp_ns, moved
