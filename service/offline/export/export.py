"""Maps and trajectories as files that other programs read."""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from shlex import quote
from typing import Literal

from service.encoding import OCCUPANCY_GRID, ODOMETRY, Message, decode_grid, decode_pose
from service.errors import InputError, UsageError
from service.geometry.geo_reference import GeoReference
from service.geometry.se2 import SE2
from service.mapstore.files import is_map_folder
from service.mapstore.geo_file import GEO_FILE
from service.mapstore.picture import Picture, picture_of_grid
from service.mapstore.png import write_png
from service.mapstore.ros_map import write_ros_map
from service.offline.export.drawings import write_dxf, write_pcd, write_ply, write_svg
from service.offline.export.geo_export import (
    Poses,
    write_csv,
    write_geojson,
    write_geotiff,
    write_kml,
    write_world_file,
)
from service.offline.export.outlines import outlines
from service.offline.importing.session_file import refuse_to_overwrite
from service.offline.past.result import GRAPH_FILE, is_ros_map, open_result
from service.offline.score.trajectory import write_tum
from service.offline.writing import complete_files
from service.readable import refuse_unreadable
from service.recording.mcap_reader import Recording

Format = Literal[
    "pgm", "png", "geotiff", "svg", "dxf", "geojson", "kml", "tum", "csv", "g2o", "ply", "pcd"
]  # fmt: skip
_REPLAY_WRITES_ONE = "a replay writes one: corridor replay SESSION.mcap --out DIR, then export DIR"


def export(source: Path, to: Format, out: Path) -> None:
    """Write the map or the trajectory of `source` to `out`, in a format that other programs read.

    source    a finished session (.mcap), the folder of a stored map, the folder that a replay wrote, or a ROS
              map (.yaml)
    to        the map: pgm with its yaml, png with its world file, geotiff, ply, pcd; the map and, where the
              source has one, the trajectory: svg, dxf, geojson; the trajectory: tum, csv, kml; the graph: g2o

    Where the source has the geodetic position of the map, png and geotiff are in UTM, svg has north, and csv
    has columns for it; geojson and kml are refused without. Raises InputError where the source does not hold
    what is requested, UsageError for a PGM by another name and for a session as its own export, StorageError,
    CorridorError where a library that only this format needs is not installed.
    """
    if to == "pgm" and out.suffix != ".pgm":
        raise UsageError(
            f"--out {out}: a map becomes NAME.pgm and NAME.yaml; write --out {out.with_suffix('.pgm')}"
        )
    refuse_unreadable(source)
    if source.is_file():
        refuse_to_overwrite(source, out)
    if is_map_folder(source) and source.resolve() in out.resolve().parents:
        raise UsageError(f"--out {out} lies inside the stored map {source}, which would damage it")
    write = _writer(_Session(source) if source.is_file() and not is_ros_map(source) else _Folder(source), to)
    with complete_files(out) as path:
        write(path)


def _writer(source: "_Source", to: Format) -> Callable[[Path], object]:
    """All is read before anything is written."""
    match to:
        case "pgm":
            return _to_path(_write_pgm, source.picture())
        case "png":
            return _to_path(_write_png, source.picture(), source.geo())
        case "geotiff":
            return _to_path(write_geotiff, source.picture(), source.geo())
        case "svg":
            return _to_path(write_svg, source.picture(), _path(source), source.geo())
        case "dxf":
            return _to_path(write_dxf, source.picture(), _path(source))
        case "ply":
            return _to_path(write_ply, source.picture())
        case "pcd":
            return _to_path(write_pcd, source.picture())
        case "tum":
            return _to_path(write_tum, source.poses())
        case "csv":
            return _to_path(write_csv, source.poses(), source.geo())
        case "kml":
            return _to_path(write_kml, source.poses(), source.needed_geo(to))
        case "geojson":
            reference = source.needed_geo(to)
            poses = source.poses() if source.has_poses else []
            walls = outlines(source.picture()) if source.has_picture else []
            return _to_path(write_geojson, poses, walls, reference)
        case "g2o":
            return _to_path(partial(Path.write_text, encoding="ascii"), source.g2o())


def _to_path(write: Callable[..., object], *content: object) -> Callable[[Path], object]:
    return lambda path: write(path, *content)


def _write_pgm(out: Path, picture: Picture) -> None:
    write_ros_map(out, out.with_suffix(".yaml"), picture)


def _write_png(out: Path, picture: Picture, reference: GeoReference | None) -> None:
    write_png(out, picture)
    write_world_file(out, picture, reference)


def _path(source: "_Source") -> list[SE2]:
    """The trajectory of the source, if it has one."""
    return [pose for _, pose in source.poses()] if source.has_poses else []


class _Folder:
    """A stored map, a result, or a ROS map. Raises InputError where what is wanted is missing or damaged."""

    def __init__(self, source: Path) -> None:
        self._source = source
        self._result = result = open_result(source)
        self.has_picture, self.has_poses = result.has_map, result.has_trajectory

    def picture(self) -> Picture:
        if not self.has_picture:
            raise InputError(self._neither())
        return self._result.picture

    def poses(self) -> Poses:
        if (trajectory := self._result.trajectory) is not None:
            return list(trajectory.poses())
        if is_map_folder(self._source):
            raise InputError(
                f"{self._source}: a stored map holds no trajectory; export the session or replay it"
            )
        raise InputError(self._neither())

    def g2o(self) -> str:
        if (g2o := self._result.g2o) is not None:
            return g2o
        if self._result.stored is not None:
            raise InputError(f"{self._source}: no graph in it; {_REPLAY_WRITES_ONE}")
        raise InputError(
            f"{self._source}: no {GRAPH_FILE} in it; its profile has no graph "
            "(corridor and submap_graph have one)"
        )

    def geo(self) -> GeoReference | None:
        return self._result.geo

    def needed_geo(self, to: str) -> GeoReference:
        if (reference := self._result.geo) is not None:
            return reference
        raise InputError(
            f"{self._source}: no {GEO_FILE} in it: the map is not geo-referenced, which {to} needs. "
            "GNSS fixes anchor a map once they agree with some 100 m of path; summary.json counts them "
            "(fixes). --format csv or tum writes the same poses in metres of the map"
        )

    def _neither(self) -> str:
        return (
            f"{self._source}: neither a stored map (v000001/ ...) nor a replay's folder "
            "(map.yaml, trajectory.tum)"
        )


class _Session:
    """A finished session; as _Folder."""

    def __init__(self, source: Path) -> None:
        self._source = source
        self._recording = Recording([source])
        self.has_picture = self._holds("/map", OCCUPANCY_GRID)
        self.has_poses = self._holds("/pose", ODOMETRY)

    def picture(self) -> Picture:
        """The last map in it."""
        last = None
        for message in self._messages("/map", OCCUPANCY_GRID):
            last = message
        if last is None:
            raise InputError(f"{self._source}: its topic /map is empty")
        return picture_of_grid(decode_grid(last.payload))

    def poses(self) -> Poses:
        poses = [decode_pose(message.payload) for message in self._messages("/pose", ODOMETRY)]
        return [(pose.stamp_ns, pose.pose) for pose in poses]

    def g2o(self) -> str:
        raise InputError(f"{self._source}: no graph in it; {_REPLAY_WRITES_ONE}")

    def geo(self) -> GeoReference | None:
        return None

    def needed_geo(self, to: str) -> GeoReference:
        raise InputError(
            f"{self._source}: a session holds no geo-reference of its map, which {to} needs; "
            f"corridor replay {quote(str(self._source))} --out DIR, then export DIR"
        )

    def _messages(self, name: str, type_name: str) -> Iterator[Message]:
        if not self._holds(name, type_name):
            topics = ", ".join(map(str, self._recording.topics)) or "nothing"
            raise InputError(
                f"{self._source}: no {name} ({type_name}) in it; it holds {topics}. "
                f"Map it first: corridor replay {quote(str(self._source))} --out DIR, then export DIR"
            )
        return self._recording.messages([name])

    def _holds(self, name: str, type_name: str) -> bool:
        topics = self._recording.topics
        return any(topic.name == name and topic.type == type_name and topic.count for topic in topics)


_Source = _Folder | _Session
