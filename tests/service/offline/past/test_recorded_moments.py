import numpy as np
import pytest

from service.encoding import STALE, encode_diagnostics, encode_frame
from service.errors import InputError
from service.offline.past.recorded_moments import RecordedMoments
from service.outputs import OCCUPIED
from tests.browser.scene import MOUNTINGS, Scene, stamp, statuses
from tests.service.offline.past.past_recordings import (
    MAPS_S,
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


def test_the_map_is_the_newest_that_was_recorded_by_then(moments):
    assert moments.tiles_at(stamp(4.9)) == ()
    assert moments.at(stamp(4.9)).map_words == "no map was recorded by then"
    for seconds, half_m in MAPS_S.items():
        assert extent_m(moments.tiles_at(stamp(seconds))) == half_m
        assert extent_m(moments.tiles_at(stamp(seconds + 4.9))) == half_m
    assert moments.at(stamp(12.3)).map_words == "map recorded 2.3 s before"
    assert moments.at(stamp(10.0)).map_words == "map recorded at this moment"


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


def test_a_recording_without_poses_is_refused_with_what_helps(tmp_path):
    write_file(tmp_path / "raw.mcap", drive(20))
    with pytest.raises(InputError, match=r"no /pose .*/front/scan.*corridor replay .*raw\.mcap --web"):
        RecordedMoments([tmp_path / "raw.mcap"])
