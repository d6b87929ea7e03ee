"""The graph of a stored map: graph.npz, and the points of its key frames in files of some hundred each.

What the points files hold never changes once their key frames are full, so a version takes them over from the
one before by a link: a checkpoint writes what is new.
"""

import hashlib
import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from service.errors import InputError
from service.mapper.saved_graph import (
    SavedGraph,
    SavedGraphError,
    from_arrays,
    packed_points,
    small_arrays,
)

GRAPH_FILE = "graph.npz"
FRAMES_A_FILE = 256
_savez: Any = np.savez_compressed  # numpy's type says of **kwds that each is a flag


def write_graph(folder: Path, graph: SavedGraph, before: Path | None) -> list[str]:
    """Names of the files written; `before` is the folder of the version before. Raises OSError."""
    names = []
    for first in range(0, len(graph), FRAMES_A_FILE):
        points = packed_points(graph, first, min(first + FRAMES_A_FILE, len(graph)))
        digest = hashlib.sha256(b"".join(array.tobytes() for array in points.values())).hexdigest()
        name = f"points_{first // FRAMES_A_FILE:05d}_{digest[:12]}.npz"
        names.append(name)
        old = None if before is None else before / name
        if old is not None and old.exists():
            os.link(old, folder / name)
            continue
        with (folder / name).open("wb") as file:
            _savez(file, **points)
    with (folder / GRAPH_FILE).open("wb") as file:
        arrays = small_arrays(graph) | {"points": np.array(names, np.str_)}
        _savez(file, **arrays)
    return [GRAPH_FILE, *names]


def read_graph(folder: Path) -> SavedGraph:
    """Raises InputError, which names the file."""
    path = folder / GRAPH_FILE
    try:
        with np.load(path, allow_pickle=False) as arrays:
            small = {name: arrays[name] for name in arrays.files if name != "points"}
            names = [str(name) for name in arrays["points"]]
        points = []
        for name in names:
            path = folder / name
            with np.load(path, allow_pickle=False) as arrays:
                points.append({key: arrays[key] for key in arrays.files})
        return from_arrays(small, points)
    except (OSError, ValueError, KeyError, zipfile.BadZipFile, SavedGraphError) as error:
        raise InputError(f"{path}: {error}") from error
