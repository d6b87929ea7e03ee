"""Real recordings as frames, and frames as a recording."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

from drivers.frames import Frame, LaserScan
from service.encoding import LogClock, encode_frame, encode_tf_static
from service.geometry.se2 import SE2
from service.offline.replay.replay import ReplayOptions, replay
from service.outputs import MapperOutput
from service.recording.mcap_recorder import McapRecorder
from service.recording.mcap_source import open_session
from simulators.worlds import WORLDS
from tests.service.recording.sessions import T0_NS, write_file
from tests.simulated import FORWARD, LMS100_50HZ, Wheels
from tests.simulated import drive as simulated_drive

DAY_S = 86_400.0  # no drive lasts so long: one file each


def frames_of(path: Path, scans: float = math.inf) -> list[Frame]:
    """Of a recording with one laser, `scan`: so many of its scans, and odometry."""
    frames, left = [], scans
    for frame in open_session([path]).frames():
        left -= isinstance(frame, LaserScan)
        if left < 0:
            break
        frames.append(frame)
    return frames


@cache
def mapped(dataset: Path) -> list[MapperOutput]:
    """Of a recording with such a name in a folder of that name, replayed once for all tests."""
    return replay([dataset / f"{dataset.name}.mcap"], ReplayOptions()).outputs


def record(frames: Sequence[Frame], mountings: Mapping[str, SE2], folder: Path, begin_ns: int) -> Path:
    """A session of the recorder in this folder, to be replayed.

    begin_ns   UTC of the moment 0 of the frames
    """
    recorder = McapRecorder(folder, "veh1", rotate_s=DAY_S, keep_free_bytes=0)
    recorder.start()
    recorder.put(encode_tf_static(mountings, begin_ns, begin_ns))
    clock = LogClock()
    for frame in frames:
        moved = replace(frame, stamp_ns=frame.stamp_ns + begin_ns, arrived_ns=frame.arrived_ns + begin_ns)
        recorder.put(encode_frame(moved, log_ns=clock.next_ns(moved.arrived_ns)))
    (session,) = recorder.finish()
    return session


def record_office(path: Path, seed: int) -> None:
    """A recording of 15 s as a demo leaves it, but of one laser."""
    driven = simulated_drive(WORLDS["office"](), replace(LMS100_50HZ, rate_hz=12.5), 15.0, seed, Wheels())
    messages = [encode_frame(frame, T0_NS) for frame in driven.frames]
    path.parent.mkdir(exist_ok=True)
    write_file(path, [encode_tf_static({"front": FORWARD}, T0_NS, T0_NS), *messages])
