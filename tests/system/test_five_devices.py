"""All five kinds of device at once, through the whole machine: as `corridor demo` has them."""

import json
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from service.encoding import decode_diagnostics, decode_frame, encode_pose
from service.offline.replay import ReplayOptions, replay
from service.recording.mcap_reader import Recording
from simulators.sick_lms100 import Lms100Setup

RATES_HZ = {
    "front": 50.0 * Lms100Setup().motor_speed,  # its motor does not turn with 50 Hz quite
    "rear": 40.0,
    "lux": 25.0,
    "imu": 200.0,
    "base": 1000.0 / 15.0,
}
CHANNELS = {"front": "scan", "rear": "scan", "lux": "scan", "imu": "imu", "base": "odom"}
COUNTED_AS_LOST = ("missed", "lost", "gap", "dropped", "discarded", "bad", "unreadable", "resync")
SOAK_S = 600
SOAK_LOOKS_S = 10.0
GROWTH_MB = 40.0  # of a map that is complete after a lap, buffers included


def test_five_devices_at_their_rates_and_nothing_lost(tmp_path: Path):
    summary = _demo(10, tmp_path)
    assert summary["rates_hz"] == {name: pytest.approx(rate, rel=0.01) for name, rate in RATES_HZ.items()}
    assert summary["scans"] > 9 * RATES_HZ["front"]
    _check_that_nothing_is_lost(summary)
    session = Path(summary["session"])
    replayed = replay([session], ReplayOptions())
    recorded = [message.payload for message in Recording([session]).messages(["/pose"])]
    assert [encode_pose(output, 0).payload for output in replayed.outputs] == recorded
    assert len(recorded) == summary["scans"]
    assert replayed.summary["scans_not_mapped"] > 9 * (RATES_HZ["rear"] + RATES_HZ["lux"])


@pytest.mark.soak
@pytest.mark.timeout(SOAK_S + 200)
def test_ten_minutes_of_five_devices_lose_nothing_and_take_no_more_memory(tmp_path: Path):
    resident_mb: list[float] = []
    summary = _demo(SOAK_S, tmp_path, lambda process: resident_mb.extend(_resident_mb(process)))
    assert summary["rates_hz"] == {name: pytest.approx(rate, rel=0.01) for name, rate in RATES_HZ.items()}
    _check_that_nothing_is_lost(summary)
    assert len(resident_mb) > 0.8 * SOAK_S / SOAK_LOOKS_S
    after_a_lap = len(resident_mb) // 5
    assert max(resident_mb[after_a_lap:]) - resident_mb[after_a_lap] < GROWTH_MB, resident_mb


def _demo(seconds: int, folder: Path, look: Callable[[int], None] | None = None) -> dict[str, Any]:
    """The demo's summary. `look` is called with its process id, again and again."""
    command = [str(Path(sys.executable).parent / "corridor"), "demo", "--json"]
    command += ["--seconds", str(seconds), "--out", str(folder)]
    ended = threading.Event()
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:

        def watch() -> None:
            while look is not None and not ended.wait(SOAK_LOOKS_S):
                look(process.pid)

        watcher = threading.Thread(target=watch)
        watcher.start()
        try:
            said, log = process.communicate(timeout=seconds + 100)
        finally:
            ended.set()
            watcher.join()
            process.kill()
    assert process.returncode == 0, log
    not_sent = [line for line in log.splitlines() if "turns_skipped" in line]
    assert not not_sent, f"the fake devices got no processor for over a second: {not_sent[-3:]}"
    summary: dict[str, Any] = json.loads(said)
    return summary


def _resident_mb(process: int) -> list[float]:
    """One value; none of a process that has just ended."""
    try:
        status = Path(f"/proc/{process}/status").read_text(encoding="ascii")
    except OSError:
        return []
    return [int(line.split()[1]) / 1024 for line in status.splitlines() if line.startswith("VmRSS:")]


def _check_that_nothing_is_lost(summary: dict[str, Any]) -> None:
    """Each stream is recorded without a hole, and no part counts a loss."""
    assert summary["scans_dropped"] == 0
    sessions = sorted(Path(summary["session"]).parent.glob("*.mcap"))
    recording = Recording(sessions)
    counts = {topic.name: topic.count for topic in recording.topics}
    *_, last = recording.messages(["/diagnostics"])
    statuses = {status.name: status.values for status in decode_diagnostics(last.payload)}
    losses = {
        f"{part} {name}": value
        for part, values in statuses.items()
        for name, value in values.items()
        if any(word in name for word in COUNTED_AS_LOST) and value != "0"
    }
    assert losses == {}
    for name, kind in CHANNELS.items():
        topic = f"/{name}/{kind}"
        assert counts[topic] == int(statuses[f"sensor/{name}"]["frames"])
        frames = [decode_frame(m.type, m.payload, name, m.log_ns) for m in recording.messages([topic])]
        stamps_ns = np.array([frame.stamp_ns for frame in frames if frame is not None])
        between_s = np.diff(stamps_ns) / 1e9
        assert len(stamps_ns) == counts[topic]
        assert between_s.max() < 1.5 / RATES_HZ[name], f"{name}: a hole of {between_s.max()} s"
