"""`corridor map info`, `log`, `verify` and `merge`."""

import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from service.errors import InputError, StorageError
from service.geometry import poses as se2
from service.mapper.by_hand import DRAWN_WALL
from service.mapper.graph.edit.merging import Merged, MergeError, merge_graphs
from service.mapper.maps.occupancy import OccupancyConfig, OccupancyTiles
from service.mapper.saved_graph import SavedGraph
from service.mapstore.edits import Version
from service.mapstore.files import StoredMap, check_versions, load_map, save_map, version_folder, versions_of
from service.offline.maps.changed_places import read_changed_places
from service.offline.writing import refuse_unwritable_folder
from service.outputs import UNKNOWN


def map_info(folder: Path, version: int | None = None) -> dict[str, Any]:
    """Facts on a version of a stored map (None: the current one), for JSON. Raises InputError where it cannot
    be read.
    """
    stored = load_map(folder, version)
    cells = sum(int((tile.cells != UNKNOWN).sum()) for tile in stored.tiles if tile.level == 0)
    files = version_folder(folder, stored.number).iterdir()
    facts: dict[str, Any] = {
        "map": str(folder),
        "version": stored.number,
        "saved": utc(stored.saved_ns),
        "edit": None if stored.edit is None else f"{stored.edit.who}: {stored.edit.words}",
        **stored.about,
        "cell_m": stored.cell_m,
        "seen_m2": round(cells * stored.cell_m**2, 1),
        "disk_mb": round(sum(path.stat().st_size for path in files) / 1e6, 2),
        "geo_reference": None if stored.geo is None else stored.geo.as_dict(),
        "can_be_gone_on_in": stored.graph is not None,
        "problems": stored.problems,
    }
    if (changed := read_changed_places(folder, stored.number)) is not None:
        facts["changed_places"] = [
            {
                "change": place.change,
                "x_m": place.x_m,
                "y_m": place.y_m,
                "area_m2": place.area_m2,
                "seen_from": utc(place.seen_from_ns),
                "seen_to": utc(place.seen_to_ns),
                "changed": utc(place.changed_ns),
                "session": place.session,
            }
            for place in changed.places
        ]
    if (graph := stored.graph) is not None:
        facts |= {
            "keyframes": len(graph),
            "loops": len(graph.loop_ends),
            "sessions_and_pieces": len(np.unique(graph.segment)),
            "refused_loops": len(graph.refused.ends),
            "pairs": len(graph.by_hand.pair_ends),
            "walls": int((graph.by_hand.kind == DRAWN_WALL).sum()),
            "areas_erased": int((graph.by_hand.kind != DRAWN_WALL).sum()),
            "stretches": stretches(graph),
            "way_m": round(float(np.hypot(*np.diff(graph.map[:, :2], axis=0).T).sum()), 1),
        }
    return facts


def stretches(graph: SavedGraph) -> list[dict[str, Any]]:
    """Begin and end of each session and segment, also in s after the first key frame."""
    first_ns = int(graph.stamp_ns.min())
    facts = []
    for segment in dict.fromkeys(graph.segment.tolist()):  # in the order driven
        stamps = graph.stamp_ns[graph.segment == segment]
        begin_ns, end_ns = int(stamps.min()), int(stamps.max())
        facts.append(
            {
                "from": utc(begin_ns),
                "to": utc(end_ns),
                "from_s": round((begin_ns - first_ns) / 1e9, 2),
                "to_s": round((end_ns - first_ns) / 1e9, 2),
                "keyframes": len(stamps),
            }
        )
    return facts


def map_verify(folder: Path) -> dict[str, Any]:
    """Read every version against its checksums. Raises InputError, which names each damaged file."""
    whole, problems = check_versions(folder)
    if problems:
        damage = "".join(f"\n  {problem}" for problem in problems)
        which = f"whole: {', '.join(map(str, whole))}" if whole else "no version is whole"
        raise InputError(f"{folder}: {which}; not readable:{damage}")
    return {"map": str(folder), "versions": whole, "problems": []}


def map_merge(folders: Sequence[Path], out: Path, pair: Sequence[float] | None) -> dict[str, Any]:
    """Merge stored maps into the first one's frame, one after the other; a summary for JSON.

    pair   (x m, y m, theta deg) of a spot in the first map, then of the same spot in the second; None: where
           they overlap is searched

    Raises InputError where a map cannot be read, overlaps too little or adds no key frame, StorageError where
    `out` cannot be written.
    """
    if out.exists():
        raise InputError(f"{out} is there already; name a new folder by --out")
    refuse_unwritable_folder(out)
    stored = [load_map(folder) for folder in folders]
    shown = OccupancyTiles(OccupancyConfig(), stored[0].cell_m)
    graph = _graph_of(stored[0], folders[0])
    steps = []
    for other, folder in zip(stored[1:], folders[1:], strict=True):
        given = None if pair is None else _pose_between(np.array(pair))
        second = _graph_of(other, folder)
        if _keyframes(second) <= _keyframes(graph):
            raise InputError(f"{folder}: all its key frames are in the maps named before it; leave it out")
        try:
            merged = merge_graphs(graph, second, shown.renderer, given)
        except MergeError as error:
            raise InputError(
                f"{folder} and what is merged so far: {error}; if they overlap, say how by --pair"
            ) from error
        assert isinstance(merged.result.saved, SavedGraph)
        graph = merged.result.saved
        steps.append(_reported(folder, merged))
    if merged.result.rendered_map is not None:
        shown.replace_by(merged.result.rendered_map, ())
    about = {**stored[0].about, "merged_from": ", ".join(str(folder) for folder in folders)}
    try:
        save_map(out, shown.changed_tiles(), max(one.saved_ns for one in stored), about, stored[0].geo, graph)
    except StorageError:
        shutil.rmtree(out, ignore_errors=True)
        raise
    return {"map": str(out), "keyframes": len(graph), "loops": len(graph.loop_ends), "merged": steps}


def _graph_of(stored: StoredMap, folder: Path) -> SavedGraph:
    if stored.graph is None:
        raise InputError(
            f"{folder}: this map holds what was shown, not what it was made of; it cannot be merged"
        )
    return stored.graph


def _keyframes(graph: SavedGraph) -> set[tuple[float, ...]]:
    """What no edit changes of each: stamp, ns, and pose in the odom frame."""
    return {
        (stamp_ns, *odom) for stamp_ns, odom in zip(graph.stamp_ns.tolist(), graph.odom.tolist(), strict=True)
    }


def _pose_between(pair: np.ndarray) -> np.ndarray:
    """(3,) pose of the second's frame in the first's, from one spot in both: x m, y m, theta deg each."""
    spots = pair.reshape(2, 3) * (1.0, 1.0, np.pi / 180.0)
    pose: np.ndarray = se2.compose(spots[0], se2.between(spots[1], np.zeros(3)))
    return pose


def _reported(folder: Path, merged: Merged) -> dict[str, Any]:
    pose = merged.pose_first_second
    return {
        "map": str(folder),
        "found_at": {
            "x_m": round(float(pose[0]), 3),
            "y_m": round(float(pose[1]), 3),
            "theta_deg": round(float(np.degrees(pose[2])), 2),
        },
        "places_found": merged.finds,
        "pairs": len(merged.loops),
        "residual_mm": {
            "rms": round(1e3 * float(np.sqrt((merged.residual_m**2).mean())), 1),
            "median": round(1e3 * float(np.median(merged.residual_m)), 1),
            "max": round(1e3 * float(merged.residual_m.max()), 1),
        },
        "residual_deg_rms": round(float(np.degrees(np.sqrt((merged.residual_rad**2).mean()))), 3),
    }


def map_log(folder: Path) -> dict[str, Any]:
    """The versions by rising number, for JSON. Raises InputError where no map can be read."""
    versions, current, problems = versions_of(folder)
    return {
        "map": str(folder),
        "current": current,
        "versions": [_version_facts(version, version.number == current) for version in versions],
        "problems": problems,
    }


def log_table(log: dict[str, Any]) -> list[list[str]]:
    """Rows of words, heads first."""
    rows = [["version", "when", "who", "what", "words"]]
    for version in log["versions"]:
        mark = "*" if version["is_current"] else ""
        rows.append([f"{version['version']}{mark}", *(version[k] for k in ("saved", "who", "what", "words"))])
    return rows


def utc(unix_ns: int) -> str:
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(unix_ns / 1e9))


def _version_facts(version: Version, is_current: bool) -> dict[str, Any]:
    edit, about = version.edit, version.about
    return {
        "version": version.number,
        "is_current": is_current,
        "saved": utc(version.saved_ns),
        "who": edit.who if edit is not None else about.get("vehicle", "-"),
        "what": edit.what if edit is not None else "saved",
        "words": edit.words if edit is not None else f"from {about.get('merged_from', 'mapping')}",
        "made_in": edit.before if edit is not None else None,
        "restores": edit.restores if edit is not None else None,
    }
