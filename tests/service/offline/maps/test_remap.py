"""A bin was put beside the path since the office was mapped: its area is driven again; only that changes."""

import io
import json
import math
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np
import pytest

from service.cli import main
from service.encoding import Message, encode_frame, encode_tf_static
from service.errors import InputError, UsageError
from service.geometry.se2 import SE2
from service.mapper.maps.occupancy import OccupancyConfig, OccupancyTiles
from service.mapstore.files import StoredMap, load_map, save_map
from service.offline.maps.remap import map_remap
from service.outputs import OCCUPIED
from tests.service.mapper.offices import LASER, in_plan, mapped_office, office_with_box, pose_plan_map
from tests.service.recording.sessions import T0_NS, write_file
from tests.simulated import FORWARD, Wheels, drive

BIN, BIN_M = (4.8, 4.95), 0.5  # middle, in the plan, and edge
AREA_M = ((3.9, 3.2), (5.7, 3.2), (5.7, 5.6), (3.9, 5.6))  # in the plan
NOW_NS = 1_763_800_000_000_000_000


def in_map(x_m: float, y_m: float) -> tuple[float, float]:
    """A place of the plan in the frame of the map."""
    at = pose_plan_map().inverse() @ SE2(x_m, y_m, 0.0)
    return at.x_m, at.y_m


def lengths(*corners: tuple[float, float]) -> list[float]:
    """As the command takes them: x and y of each corner of the plan, in the map."""
    return [length_m for corner in corners for length_m in in_map(*corner)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    _, begin = mapped_office()
    shown = OccupancyTiles(OccupancyConfig(), 0.05)
    shown.replace_by(begin.shown, ())
    folder = tmp_path_factory.mktemp("maps") / "office"
    save_map(folder, shown.changed_tiles(), 1, graph=begin.graph)
    return folder


def recorded(path: Path, seconds: float) -> Path:
    """The same path again, past the bin."""
    made = drive(office_with_box(BIN, (BIN_M, BIN_M)), LASER, seconds, 4, Wheels())
    messages: list[Message] = [encode_tf_static({"front": FORWARD}, T0_NS, T0_NS)]
    messages += [encode_frame(frame, T0_NS) for frame in made.frames]
    write_file(path, sorted(messages, key=lambda message: message.log_ns))
    return path


@pytest.fixture(scope="module")
def remapped(folder, tmp_path_factory) -> tuple[StoredMap, dict, StoredMap]:
    """By the command: the map before, its output, and the map after."""
    before, output = load_map(folder), io.StringIO()
    recording = recorded(tmp_path_factory.mktemp("drives") / "later.mcap", 14.0)
    area = [f"{length_m:.9f}" for length_m in lengths(*AREA_M)]
    command = ["map", "remap", str(folder), str(recording), "--area", *area, "--who", "ada", "--json"]
    with redirect_stdout(output):
        assert main(command) == 0
    return before, json.loads(output.getvalue()), load_map(folder)


def cells_of(stored: StoredMap) -> dict[tuple[int, int], np.ndarray]:
    return {(tile.ix, tile.iy): tile.cells for tile in stored.tiles if tile.level == 0}


def is_in_area(xy_map: np.ndarray) -> np.ndarray:
    """In the plan the area is a rectangle."""
    x, y = in_plan(xy_map).T
    (low_x, low_y), (high_x, high_y) = AREA_M[0], AREA_M[2]
    return (x >= low_x) & (x <= high_x) & (y >= low_y) & (y <= high_y)


def test_the_bin_is_in_the_map_now_and_every_cell_outside_of_the_area_is_as_it_was(remapped):
    before, facts, after = remapped
    old, new = cells_of(before), cells_of(after)
    assert old.keys() == new.keys()
    changed = []
    for (ix, iy), cells in new.items():
        row, column = np.nonzero(cells != old[ix, iy])
        edge = len(cells)
        changed.append(np.column_stack((ix * edge + column + 0.5, iy * edge + row + 0.5)) * 0.05)
    xy = np.concatenate(changed)
    assert len(xy) == facts["cells_changed"] > 50
    assert (facts["version"], facts["version_before"]) == (after.number, before.number)
    assert (after.edit.who, after.edit.what) == ("ada", "remap")
    assert is_in_area(xy).all()
    x_m, y_m = in_map(BIN[0], BIN[1] - BIN_M / 2.0)  # its side towards the path
    column, row = math.floor(x_m / 0.05), math.floor(y_m / 0.05)
    near = [
        new[(column + q) // 64, (row + r) // 64][(row + r) % 64, (column + q) % 64]
        for r in (-1, 0, 1)
        for q in (-1, 0, 1)
    ]
    assert max(near) > 0.65 * OCCUPIED


def test_of_the_graph_only_points_in_the_area_went_and_key_frames_came(remapped):
    before, facts, after = remapped
    count = len(before.graph)
    assert len(after.graph) - count == facts["keyframes_new"] > 3
    for name in ("stamp_ns", "odom", "map", "path_length_m", "covariance", "segment", "score", "sensor_xy_m"):
        np.testing.assert_array_equal(
            getattr(after.graph, name)[:count], getattr(before.graph, name), err_msg=name
        )
    assert (after.graph.point_count[:count] <= before.graph.point_count).all()
    gone = int(before.graph.point_count.sum() - after.graph.point_count[:count].sum())
    assert gone == facts["points_gone"] > 100
    assert int(after.graph.point_count[count:].sum()) == facts["points_new"] > 100
    assert len(after.graph.loop_ends) == len(before.graph.loop_ends) + 2  # what holds the drive to the map


def test_an_area_that_is_none_or_that_the_drive_did_not_see_is_refused_and_nothing_changes(folder, tmp_path):
    before, recording = load_map(folder).number, recorded(tmp_path / "later.mcap", 2.0)
    with pytest.raises(InputError, match="saw nothing of the area"):
        map_remap(folder, [recording], lengths((30, 30), (31, 30), (31, 31)), "ada", NOW_NS)
    with pytest.raises(UsageError, match="enclose no area"):  # before the drive is read
        map_remap(folder, [Path("nowhere.mcap")], [0.0, 0.0, 1.0, 0.0, 2.0, 0.0], "ada", NOW_NS)
    assert load_map(folder).number == before
