"""A demo whose devices fail in every way: the service stays, the devices come back, the session replays."""

from pathlib import Path

import numpy as np
import pytest

from service.encoding import decode_diagnostics, decode_frame, encode_pose
from service.offline.replay.replay import ReplayOptions, replay
from service.recording.mcap_reader import Recording
from tests.demo_run import run_demo

FAULTS = Path(__file__).with_name("faults.yaml")
SECONDS = 13
LOST_M = 5.0  # or more, where the map has nothing to do with the world any more
CALM_S = 2.0  # at the end of the run: no fault any more


def test_a_demo_with_faults_stays_up_and_its_session_replays(tmp_path: Path):
    run = run_demo(SECONDS, tmp_path / "o", faults=FAULTS)
    summary = run.summary
    assert summary["position_rmse_m"] < (0.05 if run.was_in_time else LOST_M)
    session = Path(summary["session"])
    assert session.suffix == ".mcap"
    recording = Recording([session])
    (*_, last) = recording.messages(["/diagnostics"])
    statuses = {status.name: status.values for status in decode_diagnostics(last.payload)}
    assert int(statuses["mapping"]["scans_dropped"]) == summary["scans_dropped"]
    for name, topic, kind, period_s in (
        ("front", "/front/scan", "sensor_msgs/msg/LaserScan", 0.02),
        ("base", "/base/odom", "nav_msgs/msg/Odometry", 0.015),
    ):
        status = statuses[f"sensor/{name}"]
        assert status["state"] == "streaming"
        assert not run.was_in_time or int(status["connects"]) >= 2  # else the fault was over before the first
        frames = [decode_frame(kind, m.payload, "x", m.log_ns) for m in recording.messages([topic])]
        stamps_ns = np.array([frame.stamp_ns for frame in frames if frame is not None])
        assert (np.diff(stamps_ns) > 0).all()
        delayed = int(status.get("count.frames_before_clock", "0"))
        assert len(stamps_ns) == int(status["frames"]) - delayed  # each is recorded or counted
        calm_ns = stamps_ns[stamps_ns > stamps_ns[-1] - CALM_S * 1e9]
        assert not run.was_in_time or len(calm_ns) == pytest.approx(CALM_S / period_s, rel=0.06)

    recorded = [m.payload for m in recording.messages(["/pose"])]
    replayed = replay([session], ReplayOptions())
    assert [encode_pose(output, 0).payload for output in replayed.outputs] == recorded
