"""Maps and trajectories as files that other programs read."""

from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Literal

from service.encoding import OCCUPANCY_GRID, ODOMETRY, decode_grid, decode_pose
from service.errors import InputError, StorageError, UsageError, words_of
from service.geometry.geo_reference import GeoReference
from service.geometry.se2 import SE2
from service.mapstore.files import is_map_folder, load_map
from service.mapstore.geo_file import GEO_FILE, read_geo
from service.mapstore.picture import Picture, picture_of_grid, picture_of_tiles
from service.mapstore.png import write_png
from service.mapstore.ros_map import read_ros_map, write_ros_map
from service.offline.drawings import write_dxf, write_svg
from service.offline.geo_export import (
    write_csv,
    write_geojson,
    write_kml,
    write_local_world_file,
    write_world_file,
)
from service.offline.geotiff import write_geotiff
from service.offline.outlines import outlines
from service.offline.point_cloud import write_pcd, write_ply
from service.offline.session_file import refuse_to_overwrite
from service.offline.trajectory import read_tum, write_tum
from service.offline.writing import whole_files
from service.readable import refuse_unreadable
from service.recording.mcap_reader import Recording

Format = Literal[
    "pgm", "png", "geotiff", "svg", "dxf", "geojson", "kml", "tum", "csv", "g2o", "ply", "pcd"
]  # fmt: skip
GRAPH_FILE = "graph.g2o"


def export(source: Path, to: Format, out: Path) -> None:
    """Write the map or the trajectory of `source` to `out`, in a format that other programs read.

    source    a finished session (.mcap), the folder of a stored map, or the folder that a replay wrote
    to        the map: pgm with its yaml, png with its world file, geotiff, ply, pcd; the map and, where the
              source has one, the trajectory: svg, dxf, geojson; the trajectory: tum, csv, kml; the graph: g2o

    Where the source says where the map lies on the earth, png and geotiff are in UTM, svg has north, and csv
    has columns for it; geojson and kml are refused without. Raises InputError where the source does not hold
    what is asked for, UsageError for a PGM by another name and for a session as its own export, StorageError,
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
    write = _writer(source, to)
    try:
        with whole_files(out) as path:
            write(path)
    except OSError as error:
        raise StorageError(f"cannot write {out}: {words_of(error)}") from error


def _writer(source: Path, to: Format) -> Callable[[Path], object]:
    """All is read before anything is written."""
    match to:
        case "pgm":
            return _to_path(_write_pgm, _picture(source))
        case "png":
            return _to_path(_write_png, _picture(source), _reference(source))
        case "geotiff":
            return _to_path(write_geotiff, _picture(source), _reference(source))
        case "svg":
            return _to_path(write_svg, _picture(source), _way(source), _reference(source))
        case "dxf":
            return _to_path(write_dxf, _picture(source), _way(source))
        case "ply":
            return _to_path(write_ply, _picture(source))
        case "pcd":
            return _to_path(write_pcd, _picture(source))
        case "tum":
            return _to_path(write_tum, list(_poses(source)))
        case "csv":
            return _to_path(write_csv, list(_poses(source)), _reference(source))
        case "kml":
            return _to_path(write_kml, list(_poses(source)), _needed_reference(source, to))
        case "geojson":
            reference = _needed_reference(source, to)
            poses = list(_poses(source)) if _has_poses(source) else []
            walls = outlines(_picture(source)) if _has_picture(source) else []
            return _to_path(write_geojson, poses, walls, reference)
        case "g2o":
            return _to_path(partial(Path.write_text, encoding="ascii"), _graph(source))


def _to_path(write: Callable[..., object], *content: object) -> Callable[[Path], object]:
    return lambda path: write(path, *content)


def _write_pgm(out: Path, picture: Picture) -> None:
    write_ros_map(out, out.with_suffix(".yaml"), picture)


def _write_png(out: Path, picture: Picture, reference: GeoReference | None) -> None:
    write_png(out, picture)
    if reference is not None:
        write_world_file(out, picture, reference)
    else:
        write_local_world_file(out, picture)


def _reference(source: Path) -> GeoReference | None:
    """Where the map of the source lies on the earth; None: that is not known."""
    if is_map_folder(source):
        return load_map(source).geo
    geo = source / GEO_FILE
    return read_geo(geo) if source.is_dir() and geo.exists() else None


def _needed_reference(source: Path, to: str) -> GeoReference:
    reference = _reference(source)
    if reference is not None:
        return reference
    if not source.is_dir():
        raise InputError(
            f"{source}: a session holds no geo-reference of its map, which {to} needs; "
            f"corridor replay {source} --out DIR, then export DIR"
        )
    raise InputError(
        f"{source}: no {GEO_FILE} in it: the map is not geo-referenced, which {to} needs. "
        "GNSS fixes anchor a map once they agree with some 100 m of path; summary.json counts them (fixes). "
        "--format csv or tum writes the same poses in metres of the map"
    )


def _picture(source: Path) -> Picture:
    if not source.is_dir():
        return _recorded_picture(source)
    if is_map_folder(source):
        return picture_of_tiles(load_map(source).tiles)
    if (source / "map.yaml").exists():
        return picture_of_grid(read_ros_map(source / "map.yaml"))
    raise InputError(_no_such_folder(source))


def _has_picture(source: Path) -> bool:
    if source.is_dir():
        return is_map_folder(source) or (source / "map.yaml").exists()
    return _holds(Recording([source]), "/map", OCCUPANCY_GRID)


def _has_poses(source: Path) -> bool:
    if source.is_dir():
        return (source / "trajectory.tum").exists()
    return _holds(Recording([source]), "/pose", ODOMETRY)


def _way(source: Path) -> list[SE2]:
    """Where the source has one."""
    return [pose for _, pose in _poses(source)] if _has_poses(source) else []


def _graph(source: Path) -> str:
    path = source / GRAPH_FILE
    if source.is_dir() and path.exists():
        return path.read_text(encoding="ascii")
    if is_map_folder(source) or not source.is_dir():
        raise InputError(
            f"{source}: no graph in it; a replay writes one: corridor replay SESSION.mcap --out DIR, then "
            "export DIR"
        )
    raise InputError(
        f"{source}: no {GRAPH_FILE} in it; its profile has no graph (corridor and submap_graph have one)"
    )


def _recorded_picture(source: Path) -> Picture:
    """The last map in a session."""
    recording = Recording([source])
    last = None
    for message in recording.messages([_topic(recording, "/map", OCCUPANCY_GRID)]):
        last = message
    if last is None:
        raise InputError(f"{source}: its topic /map is empty")
    return picture_of_grid(decode_grid(last.payload))


def _poses(source: Path) -> Iterable[tuple[int, SE2]]:
    if source.is_dir():
        if (source / "trajectory.tum").exists():
            trajectory = read_tum(source / "trajectory.tum")
            return zip(
                trajectory.stamp_ns.tolist(), (SE2(*pose) for pose in trajectory.pose.tolist()), strict=True
            )
        if is_map_folder(source):
            raise InputError(f"{source}: a stored map holds no trajectory; export the session or replay it")
        raise InputError(_no_such_folder(source))
    recording = Recording([source])
    topic = _topic(recording, "/pose", ODOMETRY)
    poses = [decode_pose(message.payload) for message in recording.messages([topic])]
    return [(pose.stamp_ns, pose.pose) for pose in poses]


def _holds(recording: Recording, name: str, type_name: str) -> bool:
    return any(topic.name == name and topic.type == type_name and topic.count for topic in recording.topics)


def _topic(recording: Recording, name: str, type_name: str) -> str:
    if _holds(recording, name, type_name):
        return name
    source = recording.paths[0]
    held = ", ".join(map(str, recording.topics)) or "nothing"
    raise InputError(
        f"{source}: no {name} ({type_name}) in it; it holds {held}. "
        f"Map it first: corridor replay {source} --out DIR, then export DIR"
    )


def _no_such_folder(source: Path) -> str:
    return f"{source}: neither a stored map (v000001/ ...) nor a replay's folder (map.yaml, trajectory.tum)"
