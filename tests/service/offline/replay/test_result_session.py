from pathlib import Path

import pytest
from rosbags.highlevel import AnyReader

from service.geometry.se2 import SE2
from service.mapstore import tiles
from service.offline.replay.replay import ReplayOptions, replay, write_replay
from service.offline.replay.result_session import RESULT_SESSION
from service.recording.mcap_reader import Recording
from tests.service.offline.recorded_drives import RecordDrive, recorder_in

SCANS, COVERED = 40, range(20, 26)


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The last optimisation moved all poses by half a metre, let us say."""
    folder = tmp_path_factory.mktemp("result")
    done = replay([recorder_in(folder)(scans=SCANS, covered=COVERED)], ReplayOptions())
    done.poses_map_base = [SE2(0.5, 0.0, 0.0) @ pose for pose in done.poses_map_base]
    write_replay(done, folder / "out", ["mcap"])
    return folder / "out"


def payloads(out: Path, topic: str) -> list[bytes]:
    return [message.payload for message in Recording([out / RESULT_SESSION]).messages([topic])]


def test_another_reader_of_ros_2_messages_finds_poses_map_states_and_loops(out: Path):
    with AnyReader([out / RESULT_SESSION]) as reader:
        messages = [
            (connection.topic, reader.deserialize(raw, connection.msgtype))
            for connection, _, raw in reader.messages()
        ]
    assert [topic for topic, _ in messages[:3]] == ["/tf_static", "/map", "/graph"]
    topics = [topic for topic, _ in messages]
    for topic in ("/pose", "/odom", "/tf", "/diagnostics"):
        assert topics.count(topic) == SCANS


def test_a_map_that_is_too_large_for_a_message_is_left_out_and_reported(
    record_drive: RecordDrive,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
):
    done = replay([record_drive()], ReplayOptions())
    monkeypatch.setattr(tiles, "MAX_GRID_CELLS", 100)
    write_replay(done, tmp_path / "out", ["mcap"])
    assert payloads(tmp_path / "out", "/map") == []
    assert len(payloads(tmp_path / "out", "/pose")) == 40
    assert "session.mcap has no /map: " in caplog.text
