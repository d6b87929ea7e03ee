"""Recordings whose stamps or time fields are wrong, replayed; and that live maps them the same way."""

import json
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from service.cli import main
from service.encoding import LogClock, encode_frame, encode_pose
from service.mapper.mapping_session import MappingSession
from service.mapper.profiles import build_mapper, mapping_config
from service.offline.importing.session_file import write_session
from service.offline.replay.replay import Replay, ReplayOptions, replay
from service.runtime.mapper_messages import FrameItem, Mapped
from service.runtime.mapping import MappingLoop
from tests.service.timing.damages import FORWARD, aligned_rms_m, damaged
from tests.service.timing.test_damaged_times import every, fields, offset, zero
from tests.shared_data import SHARED

CASES = SHARED / "cases"
with_cases = pytest.mark.usefixtures("shared")
WORSE_M = 1.3e-3  # the error of good_small.mcap against the truth


@cache
def good_replay() -> Replay:
    return replay([CASES / "good_small.mcap"], ReplayOptions())


@with_cases
@pytest.mark.parametrize(
    ("name", "dropped", "warning"),
    [
        ("odometry_96_days_behind", 0, "/odom: its stamps are 8310659.300 s (96.2 days) behind"),
        ("scan_stamps_zero", 0, "/scan: 1 stamp in 11 messages"),
        ("some_scans_years_off", 9, "/scan: 9 of 89 (10.1 %) messages are dropped: 9 with a stamp far from"),
        (
            "time_increment_in_ns",
            0,
            "/scan: time_increment 4.19e+05 s at 1.51 deg a beam is a turn in 1e+08 s",
        ),
    ],
)
def test_wrong_times_are_mended_and_reported(name: str, dropped: int, warning: str):
    good = good_replay()
    assert good.summary["warnings"] == []
    done = replay([CASES / f"{name}.mcap"], ReplayOptions())
    assert (done.summary["scans"], done.summary["scans_dropped"]) == (89 - dropped, dropped)
    (said,) = done.summary["warnings"]
    assert said.startswith(warning)
    good_poses = {
        round(output.stamp_ns / 5e7): pose
        for output, pose in zip(good.outputs, good.poses_map_base, strict=True)
    }
    kept = [round(o.stamp_ns / 5e7) for o in done.outputs]
    assert aligned_rms_m(done.poses_map_base, [good_poses[k] for k in kept]) <= WORSE_M


def test_the_last_lines_of_a_replay_name_the_topic_that_was_dropped(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
):
    session = _written(tmp_path / "drive.mcap", damaged("scan", every(10, 3, 1e8)))
    assert main(["replay", str(session), "--out", str(tmp_path / "out"), "--json"]) == 0
    said = capfd.readouterr()
    sentence = "/front/scan: 9 of 90 (10.0 %) messages are dropped: 9 with a stamp far from those around it"
    assert sentence in json.loads(said.out)["warnings"]
    assert any(line.endswith(sentence) and "WARNING" in line for line in said.err.splitlines()[-3:])


@pytest.mark.parametrize(
    ("kind", "damage"),
    [("odom", offset(-253.0)), ("scan", zero(1)), ("imu", every(3, 0, 1e6)), ("scan", fields(1 / 20, 1.0))],
    ids=["an offset", "no stamps", "odd samples", "a time_increment"],
)
def test_live_and_replay_give_the_same_poses_of_wrong_times(kind: str, damage: Any, tmp_path: Path):
    frames = damaged(kind, damage)
    mapped: list[Mapped] = []
    session = MappingSession(lambda: build_mapper(mapping_config(), {"front": FORWARD}), ["front"])
    loop = MappingLoop(
        session, lambda m: mapped.append(m) if isinstance(m, Mapped) else None, monotonic_ns=lambda: 0
    )
    log_clock = LogClock()
    for number, frame in enumerate(frames, start=1):
        message = encode_frame(frame)
        log_ns = log_clock.next_ns(frame.arrived_ns)
        loop.take(FrameItem(number, log_ns, 0, frame.sensor, message.type, message.payload))
    loop.finish()
    done = replay([_written(tmp_path / "drive.mcap", frames)], ReplayOptions())
    assert [m.stamp_ns for m in mapped] == [output.stamp_ns for output in done.outputs]
    assert [m.messages[0].payload for m in mapped] == [encode_pose(o, 0).payload for o in done.outputs]


def _written(path: Path, frames: list[Any]) -> Path:
    write_session(path, frames, {"front": FORWARD}, {}, log_times=True)
    return path
