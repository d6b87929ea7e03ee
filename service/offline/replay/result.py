"""The result of a replay, and its files."""

import json
import logging
import shutil
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np

from service import encoding
from service.archive import written_to
from service.errors import StorageError, words_of
from service.geometry.geo_reference import GeoReference
from service.geometry.se2 import SE2
from service.mapper.graph.model.graph_picture import draw_saved
from service.mapper.map_changes import MapChanges
from service.mapper.saved_graph import SavedGraph
from service.mapstore.annotated import PALETTE, annotated
from service.mapstore.files import is_map_folder, keep_version, save_map
from service.mapstore.geo_file import GEO_FILE, write_geo
from service.mapstore.picture import Picture, picture_of_tiles
from service.mapstore.png import write_png
from service.mapstore.ros_map import write_ros_map
from service.mapstore.tiles import grid_of_tiles
from service.offline.export.geo_export import Poses, write_world_file
from service.offline.export.utm import UTM_MAX_LATITUDE_DEG
from service.offline.importing.session_file import write_messages
from service.offline.maps.change_file import CHANGES_FILE, write_changes
from service.offline.past.result import (
    DONE_FILE,
    FIRST_VERSION,
    GRAPH_FILE,
    MAP_FOLDER,
    ROS_MAP_FILE,
    SUMMARY_FILE,
    TRAJECTORY_FILE,
    UNEDITED,
    open_result,
)
from service.offline.replay.states_file import STATES_FILE, sigmas_of, write_states
from service.offline.report import REPORT_FILE, write_report
from service.offline.score.trajectory import write_tum
from service.offline.writing import complete_files
from service.outputs import MapperOutput, TileUpdate

log = logging.getLogger(__name__)

RESULT_SESSION = "session.mcap"
Extra = Literal["mcap", "report"]  # what is written only on request


@dataclass(slots=True)
class Replay:
    """The result of one recording."""

    outputs: list[MapperOutput]  # as they would have been published
    lasers: list[str]  # whose scan each output answers
    poses_base_sensor: Mapping[str, SE2]
    upside_down: frozenset[str]  # sensors that are mounted so
    poses_map_base: list[SE2]  # of each output, by all that was known in the end
    tiles: list[TileUpdate]  # of the map at the end; after a reset, of the newest
    g2o: str  # its graph; "" where the profile has none
    summary: dict[str, Any]
    geo: GeoReference | None = None  # where its map lies on the earth; None: that is not known
    graph: SavedGraph | None = None  # with which a later session goes on; None: it cannot
    changes: MapChanges | None = None  # since the map was stored in which it was localised; None: it was not
    session: SavedGraph | None = None  # key frames of that map and of the drive behind them; None likewise


def write_replay(done: Replay, out: Path, extras: Collection[Extra] = ()) -> None:
    """trajectory.tum, trajectory_live.tum, states.csv, map.pgm + map.yaml, map.png, graph.g2o, geo.json,
    summary.json, and map/, the map as it is stored: `--map` and map.load begin in it. Where it was localised
    in a stored map, changes.csv: what has changed since. With the extra "mcap", session.mcap; with "report",
    report.html.

    There is no graph.g2o where the profile has no graph. Where fixes do not anchor the map there is no
    geo.json, and none of an earlier replay stays; where they do, map.png has a world file beside it, as far
    as UTM reaches. `out` is a folder or a URL; it is left as it was where not all can be written. Raises
    StorageError.

    map.png is for people: cropped, with the path, the origin and a scale bar.
    Poses are written as a subscriber or an export of the live session has them, to the last digit.
    """
    with written_to(out, remains_in) as folder:
        stamps = [output.stamp_ns for output in done.outputs]
        live = [encoding.pose_on_wire(output.pose_map_base) for output in done.outputs]
        write_tum(folder / "trajectory_live.tum", zip(stamps, live, strict=True))
        write_states(folder / STATES_FILE, done.outputs, done.lasers)
        poses = list(zip(stamps, map(encoding.pose_on_wire, done.poses_map_base), strict=True))
        _write_files(folder, poses, picture_of_tiles(done.tiles), done.g2o, done.geo, done.summary)
        write_changes(folder / CHANGES_FILE, done.changes)
        _store_map(done, folder / MAP_FOLDER)
        if "mcap" in extras:
            write_result_session(folder / RESULT_SESSION, done)
        if "report" in extras:
            write_report(folder, folder / REPORT_FILE)


def remains_in(out: Path) -> list[Path]:
    """Files and folders of an earlier result in a folder, or at a URL, that not every replay writes again."""
    names = [DONE_FILE, GRAPH_FILE, GEO_FILE, "map.pgw", "map.png.aux.xml", CHANGES_FILE, RESULT_SESSION]
    names += [REPORT_FILE, UNEDITED, *([MAP_FOLDER] if is_map_folder(out / MAP_FOLDER) else [])]
    return [out / name for name in names if (out / name).exists()]


def rewrite_result(folder: Path) -> None:
    """Rewrite the files of the result to which a stored map belongs, as its newest version has them; nothing
    where it belongs to none. What the replay wrote stays in DIR/unedited.

    Raises StorageError where they cannot be written, InputError where a file of the result is damaged.
    """
    folder = folder.resolve()
    out = folder.parent
    if folder.name != MAP_FOLDER or not (out / TRAJECTORY_FILE).is_file():
        return
    result = open_result(out)
    stored, trajectory = result.stored, result.trajectory
    assert stored is not None
    assert trajectory is not None
    try:
        _keep_unedited(out)
        with complete_files(out / TRAJECTORY_FILE) as path:
            poses = list(trajectory.poses())
            _write_files(path.parent, poses, result.picture, result.g2o or "", result.geo, result.summary)
            if trajectory is result.drive.trajectory:  # then to the last digit
                shutil.copyfile(out / UNEDITED / TRAJECTORY_FILE, path)
    except (OSError, StorageError) as error:
        raise StorageError(
            f"version {stored.number} of {folder} is stored; the files beside it cannot be rewritten: "
            f"{words_of(error)}; corridor export {out} exports that version all the same"
        ) from error


def _write_files(
    out: Path, poses: Poses, picture: Picture, g2o: str, geo: GeoReference | None, summary: Mapping[str, Any]
) -> None:
    """Write the files of one version of a map and the drive in it."""
    write_tum(out / TRAJECTORY_FILE, poses)
    if g2o:
        (out / GRAPH_FILE).write_text(g2o, encoding="ascii")
    write_ros_map(out / "map.pgm", out / ROS_MAP_FILE, picture)
    shown = annotated(picture, [np.array([(pose.x_m, pose.y_m) for _, pose in poses])])
    write_png(out / "map.png", shown, PALETTE)
    if geo is not None:
        write_geo(out / GEO_FILE, geo)
        if abs(geo.origin.latitude_deg) < UTM_MAX_LATITUDE_DEG:
            write_world_file(out / "map.png", shown, geo)
    (out / SUMMARY_FILE).write_text(json.dumps(summary, indent=1) + "\n", encoding="ascii")


def _keep_unedited(out: Path) -> None:
    """Copy what the replay wrote of its drive to DIR/unedited, unless it is there already."""
    if (out / UNEDITED).exists():
        return
    with TemporaryDirectory(prefix=".corridor-", dir=out) as folder:
        part = Path(folder) / UNEDITED
        part.mkdir()
        for name in (TRAJECTORY_FILE, GRAPH_FILE, SUMMARY_FILE):
            if (out / name).is_file():
                shutil.copy2(out / name, part)
        part.rename(out / UNEDITED)


def _store_map(done: Replay, folder: Path) -> None:
    """None where a session could not go on in it."""
    if done.graph is not None and len(done.graph):
        about = {"profile": str(done.summary["profile"])}
        save_map(folder, done.tiles, done.outputs[-1].stamp_ns, about, done.geo, done.graph)
        keep_version(folder, FIRST_VERSION, "the trajectory of the replay's result lies in this version")


def write_result_session(path: Path, done: Replay) -> None:
    """The map and the graph as they are in the end at the first stamp; from there on `/pose`, `/odom`, `/tf`
    and `/diagnostics` of each scan at its own stamp. Poses are those of trajectory.tum, covariances and
    states as live. A map that is too large for one message is left out.

    Raises StorageError.
    """
    about = {"corridor": str(done.summary["corridor"]), "profile": str(done.summary["profile"])}
    write_messages(path, _messages(done), {"replay": about})


def _messages(done: Replay) -> Iterator[encoding.Message]:
    first_ns = done.outputs[0].stamp_ns
    yield encoding.encode_tf_static(done.poses_base_sensor, first_ns, first_ns, upside_down=done.upside_down)
    try:
        yield encoding.encode_grid(grid_of_tiles(done.tiles), first_ns, first_ns)
    except StorageError as error:
        log.warning("%s has no /map: %s", RESULT_SESSION, error)
    if (graph := done.graph or done.session) is not None:
        yield encoding.encode_graph(draw_saved(graph), first_ns)
    for output, pose_map_base, laser in zip(done.outputs, done.poses_map_base, done.lasers, strict=True):
        at = replace(output, pose_map_odom=pose_map_base @ output.pose_odom_base.inverse())
        for encode in (encoding.encode_pose, encoding.encode_odom, encoding.encode_tf):
            yield encode(at, output.stamp_ns)
        yield encoding.encode_diagnostics(
            "diagnostics", [_status(output, laser)], output.stamp_ns, output.stamp_ns
        )


def _status(output: MapperOutput, laser: str) -> encoding.Status:
    along_m, across_m, heading_deg = sigmas_of(output)
    values = {
        "state": output.state,
        "reason_id": output.reason.id,
        "sigma_along_m": f"{along_m:.4f}",
        "sigma_across_m": f"{across_m:.4f}",
        "sigma_heading_deg": f"{heading_deg:.4f}",
        "inlier_ratio": f"{output.inlier_ratio:.3f}",
        "laser": laser,
    }
    return encoding.Status(
        "mapping", encoding.LEVEL_OF_STATE[output.state], output.reason or output.state, values
    )
