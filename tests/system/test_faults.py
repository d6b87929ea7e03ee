"""Devices with each kind of fault: the service goes on, the devices reconnect, the session replays."""

import signal
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from service.demo import interpolate
from service.encoding import decode_diagnostics, decode_frame, decode_pose, encode_pose
from service.offline.export.export import export
from service.offline.replay.replay import ReplayOptions, replay, write_replay
from service.recording.mcap_reader import Recording
from tests.service.recording.sessions import events_of
from tests.system.machine import FakeVehicle, LiveService, Subscriber

FAULTS = Path(__file__).with_name("faults.yaml")
SECONDS = 13.0
CALM_S = 2.0  # at the end of the run, without a fault


def test_a_drive_with_faults_stays_up_and_its_session_replays(
    tmp_path: Path, subscribe: Callable[[str], Subscriber]
):
    vehicle = FakeVehicle(tmp_path, faults=FAULTS)
    service = LiveService(tmp_path, vehicle.sensors())
    try:
        service.start()
        vehicle.start()
        over_s = time.monotonic() + SECONDS  # the faults are set by time
        subscribe(service.endpoint).wait_until(lambda: time.monotonic() > over_s)
        service.signal(signal.SIGTERM)
        assert service.wait() == 0, service.log
    finally:
        vehicle.stop()
        service.close()
    (session,) = service.sessions.glob("*.mcap")
    recording = Recording([session])
    (*_, last) = recording.messages(["/diagnostics"])
    statuses = {status.name: status.values for status in decode_diagnostics(last.payload)}
    for name, topic, kind, period_s in (
        ("front", "/front/scan", "sensor_msgs/msg/LaserScan", 0.02),
        ("base", "/base/odom", "nav_msgs/msg/Odometry", 0.015),
    ):
        status = statuses[f"sensor/{name}"]
        assert status["state"] == "streaming"
        assert int(status["connects"]) >= 2
        frames = [decode_frame(kind, m.payload, "x", m.log_ns) for m in recording.messages([topic])]
        stamps_ns = np.array([frame.stamp_ns for frame in frames if frame is not None])
        assert (np.diff(stamps_ns) > 0).all()
        delayed = int(status.get("count.frames_before_clock", "0"))
        assert len(stamps_ns) == int(status["frames"]) - delayed  # each is recorded or counted
        calm_ns = stamps_ns[stamps_ns > stamps_ns[-1] - CALM_S * 1e9]
        assert np.median(np.diff(calm_ns)) * 1e-9 == pytest.approx(period_s, rel=0.06)

    too_old = sum(event["event"] == "scan_passed_over" for event in events_of(session))
    assert np.median(errors_m(recording, vehicle.truth)) < (0.1 if too_old else 0.03)
    recorded = [m.payload for m in recording.messages(["/pose"])]
    replayed = replay([session], ReplayOptions())
    assert [encode_pose(output, 0).payload for output in replayed.outputs] == recorded
    write_replay(replayed, tmp_path / "replayed")
    export(session, "tum", tmp_path / "live.tum")
    live = (tmp_path / "live.tum").read_bytes()
    assert (tmp_path / "replayed" / "trajectory_live.tum").read_bytes() == live


def errors_m(recording: Recording, truth: Path) -> list[float]:
    """Of the poses of a recording, on a drive of a metre at the least."""
    poses = [decode_pose(message.payload) for message in recording.messages(["/pose"])]
    offset_ns = int(recording.metadata["clock"]["utc_offset_ns"])
    stamps_ns = np.array([pose.stamp_ns for pose in poses]) - offset_ns
    true = interpolate(np.loadtxt(truth), stamps_ns)
    assert np.hypot(*_offset(true[0], true[-1])) > 1.0  # it really drove
    start = true[0].inverse()
    return [np.hypot(*_offset(start @ t, p.pose)) for t, p in zip(true, poses, strict=True)]


def _offset(a, b) -> tuple[float, float]:
    return a.x_m - b.x_m, a.y_m - b.y_m
