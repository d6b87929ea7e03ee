"""A demo whose devices fail in every way: the service stays, the devices come back, the session replays."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np

from service.encoding import decode_diagnostics, decode_frame, encode_pose
from service.offline.replay import ReplayOptions, replay
from service.recording.mcap_reader import Recording

FAULTS = Path(__file__).with_name("faults.yaml")
SECONDS = 20
CALM_FROM_S = 17.0  # of the run: no fault after this


def test_a_demo_with_faults_stays_up_and_its_session_replays(tmp_path: Path):
    command = [Path(sys.executable).parent / "corridor", "demo", "--seconds", str(SECONDS), "--json"]
    command += ["--faults", FAULTS, "--out", tmp_path / "o"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=115, check=False)
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert summary["scans_dropped"] == 0
    assert summary["position_rmse_m"] < 0.05

    session = Path(summary["session"])
    assert session.suffix == ".mcap"
    recording = Recording([session])
    for topic, kind, rate_hz in (
        ("/front/scan", "sensor_msgs/msg/LaserScan", 50.0),
        ("/base/odom", "nav_msgs/msg/Odometry", 66.7),
    ):
        frames = [decode_frame(kind, m.payload, "x", m.log_ns) for m in recording.messages([topic])]
        stamps_s = np.array([frame.stamp_ns for frame in frames if frame is not None]) / 1e9
        assert (np.diff(stamps_s) > 0.0).all()
        calm = stamps_s > stamps_s[-1] - (SECONDS - CALM_FROM_S)
        assert abs(calm.sum() / (SECONDS - CALM_FROM_S) - rate_hz) < 3.0

    (*_, last) = recording.messages(["/diagnostics"])
    statuses = {status.name: status.values for status in decode_diagnostics(last.payload)}
    for name in ("sensor/front", "sensor/base"):
        assert statuses[name]["state"] == "streaming"
        assert int(statuses[name]["connects"]) >= 2

    recorded = [m.payload for m in recording.messages(["/pose"])]
    replayed = replay([session], ReplayOptions())
    assert [encode_pose(output, 0).payload for output in replayed.outputs] == recorded
