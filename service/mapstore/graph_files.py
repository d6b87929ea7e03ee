"""The graph of a stored map: graph.npz, and the points of its key frames in files of some hundred each.

What the points files hold never changes once their key frames are full, so a version takes them over from the
one before by a link: a checkpoint writes what is new.
"""

import errno
import hashlib
import os
import shutil
from collections.abc import Collection
from pathlib import Path

import numpy as np

from service.errors import InputError, words_of
from service.geometry.poses import Floats
from service.mapper.saved_graph import (
    KeptGraph,
    SavedGraph,
    SavedGraphError,
    from_arrays,
    packed_points,
    small_arrays,
)
from service.mapstore.arrays import read_arrays, write_arrays

GRAPH_FILE = "graph.npz"
FRAMES_A_FILE = 256


def write_graph(
    folder: Path, graph: SavedGraph, before: Path | None, known: dict[bytes, str] | None = None
) -> list[str]:
    """Names of the files written; `before` is the folder of the version before. Raises OSError.

    known   in and out: names of files by what identifies their key frames, for who writes one graph often
    """
    names: list[str] = []
    known = {} if known is None else known
    for first in range(0, len(graph), FRAMES_A_FILE):
        frames = slice(first, first + FRAMES_A_FILE)
        key = graph.stamp_ns[frames].tobytes() + graph.point_count[frames].tobytes()
        name, points = known.get(key, ""), None
        if not name or before is None or not (before / name).exists():
            points = packed_points(graph, first, min(first + FRAMES_A_FILE, len(graph)))
            digest = hashlib.sha256(b"".join(array.tobytes() for array in points.values())).hexdigest()
            name = known[key] = f"points_{first // FRAMES_A_FILE:05d}_{digest[:12]}.npz"
        names.append(name)
        if points is None or (before is not None and (before / name).exists()):
            assert before is not None
            os.link(before / name, folder / name)
        else:
            with (folder / name).open("wb") as file:
                write_arrays(file, points)
    with (folder / GRAPH_FILE).open("wb") as file:
        write_arrays(file, small_arrays(graph) | {"points": np.array(names, np.str_)})
    return [GRAPH_FILE, *names]


def segment_paths(folder: Path) -> list[Floats]:
    """(N, 2) m in the map each: the key frames of each segment, in order; empty without a graph."""
    if not (folder / GRAPH_FILE).exists():
        return []
    arrays = read_arrays(folder / GRAPH_FILE)
    xy, segment = arrays["map"][:, :2], arrays["segment"]
    return [one for one in np.split(xy, np.flatnonzero(np.diff(segment)) + 1) if len(one)]


class GraphFolder:
    """KeepGraph: writes the graph to a numbered folder below `folder`, each beside the one before.

    What is full and has not changed is neither packed nor written again; a graph without key frames is not
    written at all. Nothing is removed here: who saves the map may not have heard of the newest, see
    `remove_overtaken`. Can be pickled.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._number = 0
        self._before: Path | None = None
        self._known: dict[bytes, str] = {}  # what identifies the points of full files -> their names

    def __call__(self, graph: SavedGraph) -> KeptGraph:
        if not len(graph):
            return KeptGraph("", "")
        self._number += 1
        new = self._folder / f"{self._number:06d}-{os.getpid()}"  # a process forked here counts on from here
        part = new.with_name(f".part-{os.getpid()}")
        try:
            shutil.rmtree(part, ignore_errors=True)
            part.mkdir(parents=True)
            write_graph(part, graph, self._before, self._known)
            part.rename(new)
        except OSError as error:
            return KeptGraph("", f"the graph cannot be kept in {new}: {words_of(error)}")
        self._before = new
        return KeptGraph(str(new), "")


def remove_overtaken(kept: Path) -> None:
    """Remove what GraphFolder wrote before `kept`, but for the newest of it: a stand-by may tell of that one
    again. Raises OSError.
    """
    written_ns = {folder: folder.stat().st_mtime_ns for folder in kept.parent.glob("[0-9]*")}
    before = [folder for folder in written_ns if written_ns[folder] < kept.stat().st_mtime_ns]
    for folder in sorted(before, key=written_ns.__getitem__)[:-1]:
        shutil.rmtree(folder)


def link_graph(kept: Path, folder: Path) -> list[str]:
    """Put what GraphFolder wrote into the folder of a version; the names. Raises OSError."""
    names = [path.name for path in sorted(kept.iterdir())]
    for name in names:
        try:
            os.link(kept / name, folder / name)
        except OSError as error:
            if error.errno != errno.EXDEV:
                raise
            shutil.copyfile(kept / name, folder / name)  # a map that was loaded lies on another disk
    return names


def read_graph(folder: Path, files: Collection[str]) -> SavedGraph:
    """files: names of what may be read. Raises InputError, which names the file."""
    path = folder / GRAPH_FILE
    try:
        small = read_arrays(path)
        names = [str(name) for name in small.pop("points")]
        if odd := [name for name in names if name not in files]:
            raise SavedGraphError(f"{odd[0]!r} is none of the files of this version")
        return from_arrays(small, [read_arrays(folder / name) for name in names])
    except (KeyError, TypeError, SavedGraphError) as error:
        raise InputError(f"{path}: {words_of(error)}") from error
