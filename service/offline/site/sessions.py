"""Which sessions a site is built from: recordings, results of replays, or stored maps."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from drivers.counted import counted
from service.archive import is_remote
from service.errors import InputError
from service.geometry import poses as se2
from service.geometry.geo_reference import GeoReference
from service.geometry.poses import Floats
from service.geometry.se2 import SE2
from service.mapper.saved_graph import SavedGraph
from service.mapstore.files import load_map, newest_digest
from service.offline.cluster.session_task import is_result_of
from service.offline.past.result import DONE_FILE, MAP_FOLDER, SUMMARY_FILE, map_folder
from service.offline.replay.replay import group_sessions, session_name
from service.recording.opening import is_recording


@dataclass(frozen=True, slots=True)
class Given:
    """A session as it is named on the command line.

    recording   its files, to be replayed; () where it is mapped
    result      folder of the replay's result or of the stored map, or where the result goes
    digest      SHA-256 of the stored map; "" where there is none yet
    """

    name: str
    recording: tuple[Path, ...]
    result: Path
    digest: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Session:
    """A session that is mapped.

    digest   SHA-256 of its stored map
    geo      where its first key frame lies on the earth, and how well that is known; None: not known
    """

    name: str
    digest: str
    graph: SavedGraph
    geo: GeoReference | None
    cell_m: float

    def placed(self, pose_site_session: Floats) -> SavedGraph:
        """Its graph, moved to where its map frame lies in the site's, (3,) m, m, rad."""
        return replace(self.graph, map=se2.compose(pose_site_session, self.graph.map))


def given_sessions(
    paths: Sequence[Path], out: Path, replayed: Path, in_site: Mapping[str, str]
) -> tuple[list[Given], list[str]]:
    """Results and stored maps as they are, without the site's own at `out`; recordings go to folders below
    `replayed`. A folder stands for the results in it or, where there is none, for the recordings. Two of
    one name are numbered, also where one is in the site. And a warning for each folder of which something
    is passed over.

    in_site   digests of the members by name

    Raises InputError for a folder that may not be read, or without sessions.
    """
    given: list[Given] = []
    recordings: list[Path] = []
    passed_over = []
    for path in paths:
        results = [one for one in _results_in(path) if one.resolve() != out.resolve()]
        given += [Given(_name_of(one), (), one, digest_of(one)) for one in results]
        if not results:
            recordings.append(path)
        elif results != [path]:
            passed_over += _passed_over(path, results, out)
        elif inside := [
            one.name for one in sorted(path.iterdir()) if one.name != MAP_FOLDER and _is_result(one)
        ]:
            passed_over.append(
                f"{path}: a result, of which {', '.join(inside)} are passed over; name each to add it"
            )
    given = [*{one.result.resolve(): one for one in given}.values()]  # a folder, and again one in it
    for session in group_sessions(recordings) if recordings else []:
        given.append(Given(session_name(session), tuple(session), replayed))
    return _numbered(given, in_site), passed_over


def _passed_over(path: Path, results: Sequence[Path], out: Path) -> list[str]:
    """In words, what a folder of results has besides."""
    beside = f"passed over, beside {counted(len(results), 'result')}"
    words = []
    if count := sum(map(is_recording, path.iterdir())):
        words.append(f"{path}: {counted(count, 'recording')} {beside}; name each to add it")
    others = [one for one in sorted(path.iterdir()) if one.is_dir() and not one.name.startswith(".")]
    others = [one for one in others if one not in results and one.resolve() != out.resolve()]
    if names := ", ".join(one.name for one in others if not is_recording(one)):
        words.append(f"{path}: {names} {beside}: neither map nor summary.json is there")
    return words


def _results_in(path: Path) -> list[Path]:
    if is_remote(path) or not path.is_dir():
        return []
    return [path] if _is_result(path) else sorted(filter(_is_result, path.iterdir()))


def _is_result(path: Path) -> bool:
    """One without a map is left out with the reason, as it is loaded."""
    return map_folder(path) is not None or (path / SUMMARY_FILE).is_file()


def _name_of(result: Path) -> str:
    result = result.absolute()
    return result.parent.name if result.name == MAP_FOLDER else result.name


def digest_of(result: Path) -> str:
    """That of its stored map; "" where there is none that can be read."""
    try:
        folder = map_folder(result)
        return "" if folder is None else newest_digest(folder)
    except InputError:
        return ""


def _numbered(given: Sequence[Given], in_site: Mapping[str, str]) -> list[Given]:
    taken: set[str] = set()
    numbered = []
    for one in given:
        named, number = one, 1
        while named.name in taken or _is_name_of_another(named, in_site):
            number += 1
            named = replace(one, name=f"{one.name}_{number}")
        taken.add(named.name)
        if one.recording:
            result = one.result / named.name
            named = replace(named, result=result, digest=digest_of(result))
        numbered.append(named)
    return numbered


def _is_name_of_another(given: Given, in_site: Mapping[str, str]) -> bool:
    """Whether a session of this name is in the site, or was replayed for it, and is another one."""
    if not given.recording:
        return in_site.get(given.name, given.digest) != given.digest
    folder = given.result / given.name
    is_there = given.name in in_site or (folder / DONE_FILE).exists()
    return is_there and not is_result_of(folder, given.recording)


def load_session(given: Given) -> Session:
    """Raises InputError where it has no map, or one that a graph is missing of."""
    if (folder := map_folder(given.result)) is None:
        raise InputError(f"{given.result}: the replay stored no map; is there a scan in the recording?")
    stored = load_map(folder)
    if stored.graph is None or not len(stored.graph):
        raise InputError(
            f"{folder}: the map has no graph, which only the profile corridor stores; replay the recording "
            "with that profile"
        )
    geo = stored.geo
    if geo is not None:
        geo = replace(geo, pose_enu_map=geo.pose_enu_map @ SE2(*stored.graph.map[0].tolist()))
    return Session(given.name, stored.digest, stored.graph, geo, stored.cell_m)
