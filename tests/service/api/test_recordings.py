import pytest

import corridor
from tests.service.api.rooms import driven, recorded
from tests.service.recording.bags import write_ros1
from tests.service.recording.sessions import drive


def test_a_ros_1_bag_and_a_folder_are_read_too(tmp_path, recording):
    write_ros1(tmp_path / "drive.bag", drive(2))
    assert any(isinstance(frame, corridor.LaserScan) for frame in corridor.read(tmp_path / "drive.bag"))
    assert len(list(corridor.read(str(recording.parent)))) == len(driven().frames)


def test_two_drives_are_not_one_recording(tmp_path):
    recorded(tmp_path, "a.mcap")
    recorded(tmp_path, "b.mcap")
    with pytest.raises(corridor.InputError, match=r"one drive, not of 2 \(.*a\.mcap, .*b\.mcap\)"):
        corridor.read(tmp_path)


def test_topics_are_chosen_by_name_and_a_wrong_one_is_refused(recording):
    assert corridor.read(recording, scan_topics=["/front/scan"]).lasers == ("front",)
    with pytest.raises(corridor.UsageError, match="no such topic"):
        corridor.read(recording, scan_topics=["/rear/scan"])
    with pytest.raises(corridor.UsageError, match="odom_topic"):
        corridor.read(recording, odom_topic="")
