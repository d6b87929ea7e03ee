from pathlib import Path

import numpy as np
import pytest

from service.encoding import encode_grid, encode_pose
from service.errors import InputError, UsageError
from service.geometry.se2 import SE2
from service.mapstore.files import load_map, save_map
from service.mapstore.ros_map import read_ros_map
from service.offline.export.export import export
from service.offline.score.trajectory import read_tum
from service.outputs import NO_REASON, Grid, MapperOutput
from service.recording.mcap_file import McapFile
from tests.service.mapstore.tile_makers import tile

START_NS = 1_700_000_000_000_000_001
POSES = [SE2(0.1 * k, -0.05 * k, 0.3 * k - 2.0) for k in range(12)]
STAMPS = [START_NS + k * 20_000_003 for k in range(12)]


def grid(value: int) -> Grid:
    cells = np.random.default_rng(value).choice(np.array([-1, 0, 100], dtype=np.int8), size=(5, 7))
    return Grid(1, 0.05, -1.5, 2.25, cells)


@pytest.fixture
def session(tmp_path) -> Path:
    path = tmp_path / "veh1_20260101T000000Z_0001.mcap"
    file = McapFile(path, STAMPS[0])
    for k, (stamp_ns, pose) in enumerate(zip(STAMPS, POSES, strict=True)):
        output = MapperOutput(stamp_ns, pose, SE2(), (0.0, 0.0, 0.0), np.zeros((3, 3)), "ok", NO_REASON, 1.0)
        file.write(encode_pose(output, stamp_ns))
        if k % 5 == 0:
            file.write(encode_grid(grid(k), stamp_ns, stamp_ns))
    file.finish()
    return path


@pytest.fixture
def stored(tmp_path) -> Path:
    save_map(tmp_path / "depot", [tile(0, 0, 1), tile(2, -1, 2)], 1)
    return tmp_path / "depot"


def assert_is_the_trajectory(path: Path) -> None:
    back = read_tum(path)
    assert back.stamp_ns.tolist() == STAMPS
    np.testing.assert_allclose(back.pose, [[p.x_m, p.y_m, p.theta_rad] for p in POSES], atol=1e-8)


def test_the_last_map_of_a_session_becomes_a_ros_map(session, tmp_path):
    export(session, "pgm", tmp_path / "new" / "hall.pgm")
    back = read_ros_map(tmp_path / "new" / "hall.yaml")
    np.testing.assert_array_equal(back.cells, grid(10).cells)
    assert (back.cell_m, back.x_min_m, back.y_min_m) == (0.05, -1.5, 2.25)
    assert (tmp_path / "new" / "hall.yaml").read_text().startswith("image: hall.pgm\n")


def test_the_poses_of_a_session_become_a_trajectory(session, tmp_path):
    export(session, "tum", tmp_path / "drive.tum")
    assert_is_the_trajectory(tmp_path / "drive.tum")


def test_nothing_is_written_into_a_stored_map(stored):
    with pytest.raises(UsageError, match="lies inside the stored map"):
        export(stored, "pgm", stored / "map.pgm")
    assert load_map(stored).problems == []


def test_a_session_without_what_is_asked_for_says_what_it_holds(session, tmp_path):
    path = tmp_path / "poses_only.mcap"
    file = McapFile(path, 1)
    file.write(encode_grid(grid(1), 1, 1))
    file.finish()
    with pytest.raises(InputError, match=r"no /pose .* it holds /map .* corridor replay"):
        export(path, "tum", tmp_path / "a.tum")
    assert not (tmp_path / "a.tum").exists()


@pytest.mark.parametrize("to", ["png", "tum"])
def test_what_is_no_source_is_refused(tmp_path, to):
    (tmp_path / "notes.txt").write_text("hello, this is no recording")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no such file or folder"):
        export(tmp_path / "nowhere.mcap", to, tmp_path / "out" / "a")
    with pytest.raises(InputError, match="not an MCAP file"):
        export(tmp_path / "notes.txt", to, tmp_path / "out" / "a")
    with pytest.raises(InputError, match=r"neither a stored map .* nor a replay's folder"):
        export(tmp_path / "empty", to, tmp_path / "out" / "a")
    assert not (tmp_path / "out").exists()
