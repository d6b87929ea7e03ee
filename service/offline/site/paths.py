"""The path of each session in the map of the site, as a TUM file."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from service.mapper.corrections import bent
from service.offline.past.result import open_result
from service.offline.score.trajectory import Trajectory, read_tum, write_tum
from service.offline.site.growth import Site
from service.offline.writing import complete_files

PATHS = "paths"  # below the map of the site


def write_paths(
    out: Path, site: Site, results: Mapping[str, Path], known: Mapping[str, Trajectory]
) -> dict[str, Trajectory]:
    """paths/NAME.tum of each member: every pose of the result, bent to where its key frames are now. Of a map
    without a trajectory those of the key frames alone.

    results   folders of the results of new members, by name
    known     paths of the others as kept, by name; of the rest the files have where they were

    Returns what was bent, by name: to be kept. Raises InputError, StorageError.
    """
    paths = {}
    for begin, member in zip(site.begins, site.members, strict=False):
        rows = slice(begin, begin + member.keyframes)
        at_ns, k = np.unique(site.graph.stamp_ns[rows], return_index=True)
        now = site.graph.map[rows][k]
        path = out / PATHS / f"{member.name}.tum"
        was = known.get(member.name)
        if was is None and member.name in results:
            was = open_result(results[member.name]).trajectory
        elif was is None and path.exists():
            was = read_tum(path)
        if was is not None:  # a session that extended a map has its key frames, too, of other times
            is_of_path = (at_ns >= was.stamp_ns[0]) & (at_ns <= was.stamp_ns[-1])
            at_ns, now = at_ns[is_of_path], now[is_of_path]
        else:
            was = Trajectory(at_ns, now)
        paths[member.name] = was
        poses = bent(was.stamp_ns, was.pose, at_ns, was.at(at_ns), now)
        with complete_files(path) as new:
            write_tum(new, Trajectory(was.stamp_ns, poses).poses())
    return paths
