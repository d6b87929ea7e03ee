"""Recordings whose stamps or time fields are wrong: the topic is named, and live maps them the same."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from drivers.frames import Frame, ImuSample, LaserScan, OdometrySample
from service.encoding import LogClock, encode_frame, encode_pose
from service.geometry.se2 import SE2
from service.mapper.mapping_session import MappingSession
from service.mapper.profiles import build_mapper, mapping_config
from service.offline.importing.session_file import write_session
from service.offline.replay.replay import ReplayOptions, replay
from service.runtime.mapper_messages import FrameItem, Mapped
from service.runtime.mapping import MappingLoop
from simulators.truth import LMS100
from simulators.worlds import build_world
from tests.simulated import FORWARD, Imu, Laser, Wheels, drive

SLOW_LASER = Laser(LMS100, 136, 10.0, -135.0, 2.0)  # a wrong time_increment shows in what it sees in a turn
BEGAN_NS = 1_700_000_000_123_456_789
Damage = Callable[[Any], Any]  # frame -> frame


@cache
def good_drive() -> tuple[list[Frame], dict[int, SE2]]:
    """Frames by log time, and where the base was at each scan, by its log time."""
    made = drive(build_world("office"), SLOW_LASER, 8.4, 3, Wheels(), Imu())
    later = [
        replace(f, stamp_ns=f.stamp_ns + BEGAN_NS, arrived_ns=f.arrived_ns + BEGAN_NS) for f in made.frames
    ]
    scans = (f for f in later if isinstance(f, LaserScan))
    return later, {f.arrived_ns: made.truth[f.stamp_ns - BEGAN_NS] for f in scans}


def off_by(seconds: float) -> Damage:
    return lambda frame: replace(frame, stamp_ns=frame.stamp_ns + round(seconds * 1e9))


def unstamped(frame: Any) -> Any:
    return replace(frame, stamp_ns=0)


def slow_beams(frame: Any) -> Any:
    return replace(frame, beam_interval_ns=frame.beam_interval_ns // 20)


@pytest.mark.parametrize(
    ("kind", "damage", "warning"),
    [
        (OdometrySample, off_by(-253.0), "/base/odom: its stamps are 253.000 s behind"),
        (ImuSample, off_by(-0.2), "/imu/imu: its stamps are 0.20"),
        (LaserScan, unstamped, "/front/scan: "),
        (LaserScan, slow_beams, "/front/scan: time_increment "),
    ],
    ids=["an offset", "a lag", "no stamps", "a time_increment"],
)
def test_wrong_times_are_named_and_give_the_same_poses_live_and_in_a_replay(
    kind: type[Frame], damage: Damage, warning: str, tmp_path: Path
):
    good, truth = good_drive()
    frames = [damage(frame) if isinstance(frame, kind) else frame for frame in good]
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
    write_session(tmp_path / "drive.mcap", frames, {"front": FORWARD}, {}, log_times=True)
    done = replay([tmp_path / "drive.mcap"], ReplayOptions())
    assert [m.stamp_ns for m in mapped] == [output.stamp_ns for output in done.outputs]
    assert [m.messages[0].payload for m in mapped] == [encode_pose(o, 0).payload for o in done.outputs]
    assert done.summary["warnings"][0].startswith(warning)
    assert len(done.outputs) == len(truth)
    away = truth[max(truth)].inverse() @ done.outputs[-1].pose_map_base
    assert math.hypot(away.x_m, away.y_m) < 0.01
