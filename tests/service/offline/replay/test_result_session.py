import pytest
from rosbags.highlevel import AnyReader

from service.offline.replay.replay import ReplayOptions, replay, write_replay
from service.offline.replay.result_session import RESULT_SESSION
from tests.service.offline.recorded_drives import RecordDrive

SCANS = 40


def test_another_reader_of_ros_2_messages_finds_poses_map_states_and_loops(
    record_drive: RecordDrive, tmp_path
):
    done = replay([record_drive(scans=SCANS)], ReplayOptions())
    done.poses_map_base = [
        pose.inverse() for pose in done.poses_map_base
    ]  # as the last optimisation left them
    write_replay(done, tmp_path / "out", ["mcap"])
    with AnyReader([tmp_path / "out" / RESULT_SESSION]) as reader:
        messages = [
            (connection.topic, reader.deserialize(raw, connection.msgtype))
            for connection, _, raw in reader.messages()
        ]
    topics = [topic for topic, _ in messages]
    assert topics[:3] == ["/tf_static", "/map", "/graph"]
    for topic in ("/odom", "/tf", "/diagnostics"):
        assert topics.count(topic) == SCANS
    positions = [message.pose.pose.position for topic, message in messages if topic == "/pose"]
    expected = [pose.x_m for pose in done.poses_map_base]
    assert [place.x for place in positions] == pytest.approx(expected, abs=1e-12)
