"""Who saves a map with its graph is killed at random moments: what is there then is always a whole one."""

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from service.mapper.saved_graph import SavedGraph
from service.mapstore import files
from service.mapstore.files import KEEP_VERSIONS, check_versions, load_map, save_map
from service.mapstore.ros_map import read_ros_map
from tests.service.mapstore.graphs import KEYFRAMES_A_VERSION, growing_graph
from tests.service.mapstore.tile_makers import tile

LONGEST_S = 0.5  # from a save to the kill: some saves
SAVE_FOR_EVER = """
import sys
from pathlib import Path
from service.mapstore.files import save_map
from service.mapstore.graph_files import GraphFolder
from tests.service.mapstore.graphs import growing_graph
from tests.service.mapstore.tile_makers import tile
folder, version = Path(sys.argv[1]), int(sys.argv[2])
keep = GraphFolder(folder / "kept")
while True:
    version += 1
    tiles = [tile(x, y, version, value=version % 101) for x in range(4) for y in range(4)]
    graph = growing_graph(version)
    # As the live service does, which puts the graph away beside the map and links it; and as an edit does.
    kept = Path(keep(graph).folder) if version % 2 else graph
    save_map(folder / "map", tiles, version, graph=kept)
    print(version, flush=True)
"""


@pytest.mark.parametrize(
    "kills",
    [
        pytest.param(3, id="3 kills"),
        pytest.param(200, id="200 kills", marks=pytest.mark.soak),
    ],
)
@pytest.mark.timeout(3600)
def test_a_kill_at_any_moment_leaves_a_whole_map_with_its_graph_and_its_loops(tmp_path: Path, kills: int):
    random, saved = np.random.default_rng(kills), 0
    for _ in range(kills):
        saved = max(saved, _killed_saver(tmp_path, saved, float(random.uniform(0.0, LONGEST_S))))
        stored = load_map(tmp_path / "map")
        assert stored.problems == []
        assert stored.saved_ns in (saved, saved + 1)  # the kill may come between the save and its print
        saved = stored.saved_ns
        assert (stored.tiles[0].cells == saved % 101).all()
        assert stored.graph is not None
        _assert_same(stored.graph, growing_graph(saved))
        assert read_ros_map(tmp_path / "map" / "map.yaml").cells.shape == (32, 32)
    assert check_versions(tmp_path / "map")[1] == []  # nor is one of the versions before damaged
    assert saved > kills


def test_a_kill_while_an_old_version_goes_leaves_no_half_of_it(tmp_path, monkeypatch):
    class Killed(BaseException):
        pass

    def half_gone(path: Path) -> None:
        (path / "manifest.json").unlink()
        raise Killed

    for version in range(1, KEEP_VERSIONS + 1):
        save_map(tmp_path, [tile(0, 0, version)], version)
    monkeypatch.setattr(files.shutil, "rmtree", half_gone)
    with pytest.raises(Killed):
        save_map(tmp_path, [tile(0, 0, 4)], 4)
    monkeypatch.undo()
    assert check_versions(tmp_path) == ([2, 3, 4], [])
    save_map(tmp_path, [tile(0, 0, 5)], 5)
    assert check_versions(tmp_path) == ([3, 4, 5], [])
    assert not list(tmp_path.glob(".unfinished-*"))


def _killed_saver(folder: Path, saved: int, after_s: float) -> int:
    """Number of the last version that a saver said is there; it is killed so long after its first."""
    with subprocess.Popen(
        [sys.executable, "-c", SAVE_FOR_EVER, str(folder), str(saved)], stdout=subprocess.PIPE, text=True
    ) as saver:
        assert saver.stdout is not None
        first = int(saver.stdout.readline())
        with pytest.raises(subprocess.TimeoutExpired):
            saver.wait(after_s)
        saver.send_signal(signal.SIGKILL)
        return max([first, *map(int, saver.stdout.read().split())])


def _assert_same(found: SavedGraph, expected: SavedGraph) -> None:
    assert len(found) == len(expected)
    assert len(found) % KEYFRAMES_A_VERSION == 0
    for name in ("stamp_ns", "map", "loop_ends", "loop_measured", "loop_covariance"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)
    np.testing.assert_allclose(found.xy_base, expected.xy_base, atol=0.00051)
    assert len(found.loop_ends) > 0
