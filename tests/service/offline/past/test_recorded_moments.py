import json

import numpy as np
import pytest

from service.encoding import STALE, encode_diagnostics, encode_frame
from service.errors import InputError
from service.offline.past.recorded_moments import RecordedMoments
from service.outputs import OCCUPIED
from tests.browser.scene import MOUNTINGS, Scene, stamp, statuses
from tests.service.offline.past.past_recordings import (
    DEGRADED_S,
    GRAPH_S,
    MAPS_S,
    MARK_S,
    RESET_S,
    write_past,
)
from tests.service.recording.sessions import drive, write_file

LATE_S = 0.0081  # a little more than it takes until a pose is known


@pytest.fixture(scope="module")
def moments(tmp_path_factory):
    return RecordedMoments(write_past(tmp_path_factory.mktemp("past")))


def extent_m(tiles):
    """Of the walls in it: half width and half height."""
    walls = [
        (tile.ix * 64 + column, tile.iy * 64 + row)
        for tile in tiles
        for row, column in np.argwhere(tile.cells == OCCUPIED).tolist()
    ]
    return tuple((0.05 * (np.max(walls, axis=0) + 1)).round(2).tolist())


@pytest.mark.parametrize("seconds", [1.0 + LATE_S, 1.05, 1.1 + LATE_S - 1e-3])
def test_a_moment_has_what_was_known_then_and_nothing_that_came_later(moments, seconds):
    moment = moments.at(stamp(seconds))
    expected = Scene().pose(1.0)
    assert moment.poses[-1].stamp_ns == stamp(1.0) + 1
    assert moment.poses[-1].pose.x_m == pytest.approx(expected.x_m, abs=1e-9)
    assert [pose.stamp_ns for pose in moment.poses] == sorted({pose.stamp_ns for pose in moment.poses})
    scanned_s = 1.1 if seconds >= 1.105 else 1.0  # 5 ms after it was measured, before its pose
    assert {scan.sensor: scan.stamp_ns for scan in moment.scans} == dict.fromkeys(MOUNTINGS, stamp(scanned_s))
    assert moment.mountings["front"] == MOUNTINGS["front"]
    np.testing.assert_array_equal(moment.scans[0].range_m, Scene().scan("front", scanned_s).range_m)


def test_the_path_ends_where_the_vehicle_is_and_begins_at_the_newest_map(moments):
    first, end = moments.at(stamp(8.0)).path
    driven = moments.path_map[first:end]
    newest = Scene().pose(7.9)
    assert first == 0
    assert np.hypot(*(driven[-1] - (newest.x_m, newest.y_m))) < 0.11
    first, end = moments.at(stamp(14.0)).path
    begins = Scene().pose(12.1)
    assert np.hypot(*(moments.path_map[first] - (begins.x_m, begins.y_m))) < 0.11
    assert moments.at(stamp(RESET_S)).path[0] == moments.at(stamp(RESET_S)).path[1]
    assert moments.at(stamp(RESET_S - 0.001)).path[0] == 0


def test_the_map_is_the_newest_that_was_recorded_by_then(moments):
    assert moments.tiles_at(stamp(4.9)) == ()
    assert moments.at(stamp(4.9)).map_words == "no map was recorded by then"
    for seconds, half_m in MAPS_S.items():
        assert extent_m(moments.tiles_at(stamp(seconds))) == half_m
        assert extent_m(moments.tiles_at(stamp(seconds + 4.9))) == half_m
    assert moments.at(stamp(12.3)).map_words == "map recorded 2.3 s before"
    assert moments.at(stamp(10.0)).map_words == "map recorded at this moment"


def test_health_says_since_when_it_was_so(moments):
    def mapping(seconds):
        rows = moments.at(stamp(seconds)).statuses
        return next((s.values["state"], since) for s, since in rows if s.name == "mapping")

    assert mapping(6.5) == ("ok", stamp(0.0) / 1e9)
    assert mapping(8.9) == ("degraded", stamp(DEGRADED_S[0]) / 1e9)
    assert mapping(11.0) == ("ok", stamp(DEGRADED_S[1]) / 1e9)


def test_events_and_graph_are_those_until_then(moments):
    def events(seconds):
        return [json.loads(text)["event"] for _, text in moments.at(stamp(seconds)).events]

    assert (events(MARK_S - 0.1), events(MARK_S), events(13.0)) == ([], ["mark"], ["mark", "reset_map"])
    assert len(moments.at(stamp(GRAPH_S - 0.1)).graph.paths) == 0
    assert len(moments.at(stamp(GRAPH_S)).graph.paths) == 1


def test_what_stands_and_what_has_changed_is_the_newest_of_the_present_map(moments):
    def percent(seconds):
        grid = moments.at(stamp(seconds)).standing
        return None if grid is None else int(grid.cells[0, 0])

    def changed(seconds):
        return moments.at(stamp(seconds)).changes.cells.tolist()

    assert [percent(s) for s in (1.9, 2.0, 5.0, RESET_S - 0.01)] == [None, 20, 40, 40]
    assert [percent(s) for s in (RESET_S, 14.0)] == [None, 60]
    assert [changed(s) for s in (2.9, 3.0, 5.0, RESET_S)] == [[], [[100]], [[0]], []]


def test_a_laser_that_fell_silent_is_not_of_the_moment_and_the_vehicle_is_where_it_was_last(moments):
    assert [scan.sensor for scan in moments.at(stamp(15.2)).scans] == ["front", "rear"]
    assert [scan.sensor for scan in moments.at(stamp(16.0)).scans] == ["front"]
    (pose,) = moments.at(moments.last_ns).poses
    assert pose.stamp_ns == stamp(16.9) + 1


def test_before_the_first_pose_there_is_none(tmp_path):
    health = encode_diagnostics("diagnostics", statuses(), stamp(-1.0), stamp(-1.0))
    pose = Scene().messages(0.0)[1]
    write_file(tmp_path / "late.mcap", [encode_frame(Scene().scan("front", -2.0)), health, pose])
    moments = RecordedMoments([tmp_path / "late.mcap"])
    at_first = moments.at(moments.first_ns)
    assert (at_first.poses, at_first.path, at_first.mountings) == ([], (0, 0), {})
    ((mapping, _),) = at_first.statuses
    assert (mapping.name, mapping.level) == ("mapping", STALE)
    assert len(moments.at(stamp(-0.5)).statuses) == len(statuses())


def test_a_drive_in_several_files_is_one(tmp_path, moments):
    cut = RecordedMoments(write_past(tmp_path, cut_s=6.05))
    assert (cut.first_ns, cut.last_ns) == (moments.first_ns, moments.last_ns)
    np.testing.assert_array_equal(cut.path_map, moments.path_map)
    for seconds in (3.0, 6.0, 6.2, 13.0):
        one, two = moments.at(stamp(seconds)), cut.at(stamp(seconds))
        assert (one.path, one.events, one.map_words) == (two.path, two.events, two.map_words)
        assert [s.stamp_ns for s in one.scans] == [s.stamp_ns for s in two.scans]


def test_a_recording_without_poses_is_refused_with_what_helps(tmp_path):
    write_file(tmp_path / "raw.mcap", drive(20))
    with pytest.raises(InputError, match=r"no /pose .*/front/scan.*corridor replay .*raw\.mcap --web"):
        RecordedMoments([tmp_path / "raw.mcap"])
