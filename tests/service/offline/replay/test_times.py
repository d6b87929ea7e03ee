"""Recordings whose stamps or time fields are wrong are reported, and live maps them the same way."""

from pathlib import Path
from typing import Any

import pytest

from service.encoding import LogClock, encode_frame, encode_pose
from service.mapper.mapping_session import MappingSession
from service.mapper.profiles import build_mapper, mapping_config
from service.offline.importing.session_file import write_session
from service.offline.replay.replay import ReplayOptions, replay
from service.runtime.mapper_messages import FrameItem, Mapped
from service.runtime.mapping import MappingLoop
from tests.service.timing.damages import FORWARD, damaged
from tests.service.timing.test_damaged_times import every, fields, offset, zero


@pytest.mark.parametrize(
    ("kind", "damage"),
    [("odom", offset(-253.0)), ("scan", zero(1)), ("imu", every(3, 0, 1e6)), ("scan", fields(1 / 20, 1.0))],
    ids=["an offset", "no stamps", "odd samples", "a time_increment"],
)
def test_live_and_replay_give_the_same_poses_of_wrong_times(kind: str, damage: Any, tmp_path: Path):
    frames = damaged(kind, damage)
    frames = frames[: len(frames) // 2]
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
