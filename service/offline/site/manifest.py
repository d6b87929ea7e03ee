"""site.json: the members of a site, in the order of their key frames in its map, and who was left out.

It is written before each new version of the map. So a version has the first members of the list, as many as
its key frames make, whatever breaks a build off and whichever version an undo makes the newest one.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from service.errors import InputError, words_of
from service.geometry.geo_reference import GeoReference
from service.mapper.saved_graph import SavedGraph
from service.mapstore.files import StoredMap
from service.offline.site.growth import Member
from service.offline.writing import complete_files

SITE_FILE = "site.json"
FORMAT = 1


@dataclass(frozen=True, slots=True)
class LeftOut:
    """digest   of the session's stored map; "" where it could not be mapped
    known    members of the site that it was searched in
    """

    digest: str
    known: int
    why: str


def write_manifest(folder: Path, members: Sequence[Member], left_out: Mapping[str, LeftOut]) -> None:
    """Raises StorageError."""
    content = {
        "format": FORMAT,
        "members": [{**asdict(one), "geo": one.geo and one.geo.as_dict()} for one in members],
        "left_out": {name: asdict(one) for name, one in left_out.items()},
    }
    with complete_files(folder / SITE_FILE) as path:
        path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def read_manifest(folder: Path, stored: StoredMap) -> tuple[list[Member], dict[str, LeftOut]]:
    """Members of the map as it is stored now, and who was left out. Raises InputError where site.json is
    damaged, or the map has other key frames than a build gave it.
    """
    path = folder / SITE_FILE
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["format"] != FORMAT:
            raise InputError(f"{path}: format {content['format']}, this version reads {FORMAT}")
        members = [_member(one) for one in content["members"]]
        left_out = {name: LeftOut(**one) for name, one in content["left_out"].items()}
    except FileNotFoundError:
        raise InputError(
            f"{folder}: a map that no site build made; name a new folder by --out, and this map among the "
            "sessions"
        ) from None
    except OSError as error:
        raise InputError(f"{path}: {words_of(error)}") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{path}: no list of a site's sessions: {words_of(error)}; build a new site"
        ) from error
    return _of_graph(folder, stored.graph, members), left_out


def _of_graph(folder: Path, graph: SavedGraph | None, members: Sequence[Member]) -> list[Member]:
    count = 0 if graph is None else len(graph)
    ends = np.cumsum([one.keyframes for one in members])
    there = int(np.searchsorted(ends, count, side="right"))
    begin = 0
    for one in members[:there]:
        assert graph is not None
        end = begin + one.keyframes
        if one.stamps_ns != (int(graph.stamp_ns[begin]), int(graph.stamp_ns[end - 1])):
            break
        begin = end
    if not count or begin != count:
        raise InputError(
            f"{folder}: its map has {count} key frames, and {SITE_FILE} knows the sessions of {begin} of "
            "them: it was cut, remapped or extended by a session since the last build. Take that back by "
            "corridor map edit --undo, or name a new folder by --out"
        )
    return list(members[:there])


def _member(content: Mapping[str, Any]) -> Member:
    first_ns, last_ns = content["stamps_ns"]
    geo = content["geo"]
    return Member(
        str(content["name"]),
        str(content["digest"]),
        int(content["keyframes"]),
        (int(first_ns), int(last_ns)),
        None if geo is None else GeoReference.from_dict(geo),
    )
