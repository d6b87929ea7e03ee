"""Real recordings as frames, and frames as a recording."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from drivers.frames import NO_INTENSITY, Frame, LaserScan, OdometrySample
from service.encoding import LogClock, encode_frame, encode_tf_static
from service.geometry.se2 import SE2
from service.recording.mcap_recorder import McapRecorder
from simulators.worlds import WORLDS
from tests.service.recording.sessions import T0_NS, write_file
from tests.simulated import FORWARD, LMS100_50HZ, Wheels
from tests.simulated import drive as simulated_drive

DAY_S = 86_400.0  # no drive lasts so long: one file each


def frames_of(path: Path, scans: int = -1) -> list[Frame]:
    """So many scans (-1: all), and odometry, by stamp; of equal stamps odometry first, as on a vehicle."""
    frames: list[Frame] = []
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        for connection, _, raw in reader.messages():
            if connection.topic not in ("/scan", "/odom"):
                continue
            if scans == 0:
                break
            message = reader.deserialize(raw, connection.msgtype)
            stamp_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            if connection.topic == "/odom":
                place, turn = message.pose.pose.position, message.pose.pose.orientation
                theta_rad = 2.0 * math.atan2(turn.z, turn.w)
                frames.append(
                    OdometrySample(
                        "base", stamp_ns, stamp_ns, place.x, place.y, theta_rad, (0.0, 0.0, 0.0), (0.0,) * 9
                    )
                )
                continue
            scans -= 1
            range_m = np.array(message.ranges, np.float32)
            range_m[~np.isfinite(range_m)] = np.nan
            frames.append(
                LaserScan(
                    "laser",
                    stamp_ns,
                    stamp_ns,
                    round(message.time_increment * 1e9),
                    round(message.scan_time * 1e9),
                    message.angle_min,
                    message.angle_increment,
                    message.range_min,
                    message.range_max,
                    range_m,
                    NO_INTENSITY,
                )
            )
    return sorted(frames, key=lambda frame: (frame.stamp_ns, isinstance(frame, LaserScan)))


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
    driven = simulated_drive(WORLDS["office"](), replace(LMS100_50HZ, rate_hz=25.0), 15.0, seed, Wheels())
    messages = [encode_frame(frame, T0_NS) for frame in driven.frames]
    path.parent.mkdir(exist_ok=True)
    write_file(path, [encode_tf_static({"front": FORWARD}, T0_NS, T0_NS), *messages])
