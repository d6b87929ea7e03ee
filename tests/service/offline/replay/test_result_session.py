import shutil
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from service.encoding import LEVEL_OF_STATE, decode_diagnostics, decode_grid, decode_pose, decode_transforms
from service.geometry.se2 import SE2
from service.mapstore import tiles
from service.offline.replay.replay import ReplayOptions, replay, write_replay
from service.offline.replay.result_session import RESULT_SESSION
from service.offline.replay.states_file import read_states
from service.offline.score.trajectory import read_tum
from service.recording.mcap_reader import Recording
from tests.service.offline.replay.test_replay import RecordDrive, record_drive, recorder_in  # noqa: F401 - a fixture

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


def test_poses_are_those_of_the_trajectory_and_tf_leads_to_them(out: Path):
    trajectory = read_tum(out / "trajectory.tum")
    poses = [decode_pose(payload) for payload in payloads(out, "/pose")]
    assert [pose.stamp_ns for pose in poses] == trajectory.stamp_ns.tolist()
    found = [(pose.pose.x_m, pose.pose.y_m, pose.pose.theta_rad) for pose in poses]
    np.testing.assert_allclose(found, trajectory.pose, atol=1e-8)
    for payload, pose in zip(payloads(out, "/tf"), poses, strict=True):
        map_odom, odom_base = (edge.pose for edge in decode_transforms(payload))
        base = map_odom @ odom_base
        np.testing.assert_allclose((base.x_m, base.y_m), (pose.pose.x_m, pose.pose.y_m), atol=1e-9)


def test_each_scan_has_its_state_its_reason_and_its_sigmas(out: Path):
    states = read_states(out / "states.csv")
    assert states.state.count("degraded") == states.reason_id.count("few_returns") == len(COVERED)
    for k, payload in enumerate(payloads(out, "/diagnostics")):
        (status,) = decode_diagnostics(payload)
        assert status.level == LEVEL_OF_STATE[states.state[k]]
        assert (status.values["state"], status.values["reason_id"]) == (states.state[k], states.reason_id[k])
        assert status.values["laser"] == "front"
        assert float(status.values["sigma_along_m"]) == pytest.approx(states.sigma[k, 0], abs=1e-4)


def test_the_map_is_that_of_the_result(out: Path):
    (payload,) = payloads(out, "/map")
    walls = (decode_grid(payload).cells >= 65).sum()
    assert walls == (out / "map.pgm").read_bytes()[-decode_grid(payload).cells.size :].count(0)


def test_a_map_that_is_too_large_for_a_message_is_left_out_and_said(
    record_drive: RecordDrive,  # noqa: F811
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


def test_a_replay_without_a_session_leaves_none_of_an_earlier_one(
    out: Path,
    tmp_path: Path,
    record_drive: RecordDrive,  # noqa: F811
):
    again = Path(shutil.copytree(out, tmp_path / "out"))
    write_replay(replay([record_drive("w")], ReplayOptions()), again)
    assert not (again / RESULT_SESSION).exists()


def test_the_same_recording_gives_the_same_bytes(tmp_path: Path, record_drive: RecordDrive):  # noqa: F811
    folders = [tmp_path / name for name in ("one", "two")]
    for folder in folders:
        drive = record_drive(folder.name, scans=SCANS, covered=COVERED)
        write_replay(replay([drive], ReplayOptions()), folder, ["mcap"])
    for name in (RESULT_SESSION, "states.csv"):
        assert len({(folder / name).read_bytes() for folder in folders}) == 1
