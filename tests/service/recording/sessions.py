"""Messages and files that the tests of the recording share."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rosbags.highlevel import AnyReader

from drivers.frames import NO_INTENSITY, LaserScan, OdometrySample
from service.encoding import Message, decode_event, encode_frame, encode_tf_static
from service.geometry.se2 import SE2
from service.recording.mcap_file import McapFile
from service.recording.mcap_reader import Recording

T0_NS = 1_763_719_200_000_000_000  # 2025-11-21 10:00:00 UTC
PLENTY = 1 << 40  # bytes free on a disk
PERIOD_NS = 20_000_000  # 50 scans a second
MOUNTINGS = {"front": SE2(0.2, 0.0, 0.3)}
FIRST_RAD, STEP_RAD = -2.3, 0.0087
ROOM_M = (-5.0, 7.0, -4.0, 6.0)  # x and y of the walls of the room that is driven through
NOISE_M = 0.01


def pose_at(index: int) -> SE2:
    """Of the base, at scan `index`."""
    return SE2(0.01 * index, 0.0, 0.001 * index)


def ranges_in_room(index: int, beams: int) -> npt.NDArray[np.float32]:
    """What the laser measures; where nothing fits the map, a mapper searches for seconds."""
    laser = pose_at(index) @ MOUNTINGS["front"]
    angle = laser.theta_rad + FIRST_RAD + STEP_RAD * np.arange(beams) + 1e-7  # none quite along a wall
    x_low, x_high, y_low, y_high = ROOM_M
    to_x = (np.where(np.cos(angle) > 0.0, x_high, x_low) - laser.x_m) / np.cos(angle)
    to_y = (np.where(np.sin(angle) > 0.0, y_high, y_low) - laser.y_m) / np.sin(angle)
    noise_m = np.random.default_rng(index).normal(0.0, NOISE_M, beams)
    return (np.minimum(to_x, to_y) + noise_m).astype(np.float32)


def scan_message(index: int, sensor: str = "front", beams: int = 541) -> Message:
    """Scan `index` of a 50 Hz laser; noisy, so it does not compress to nothing."""
    ranges = ranges_in_room(index, beams)
    stamp_ns = T0_NS + index * PERIOD_NS
    return encode_frame(
        LaserScan(
            sensor=sensor,
            stamp_ns=stamp_ns,
            arrived_ns=stamp_ns + 5_000_000,
            beam_interval_ns=27_778,
            scan_period_ns=PERIOD_NS,
            first_angle_rad=FIRST_RAD,
            angle_step_rad=STEP_RAD,
            range_min_m=0.05,
            range_max_m=25.0,
            range_m=ranges,
            intensity=NO_INTENSITY,
        )
    )


def odometry_message(index: int) -> Message:
    stamp_ns = T0_NS + index * PERIOD_NS + 1_000_000
    at = pose_at(index)
    pose = (at.x_m, at.y_m, at.theta_rad)
    return encode_frame(
        OdometrySample("base", stamp_ns, stamp_ns + 1_000_000, *pose, (0.5, 0.0, 0.05), (0.0,) * 9)
    )


def mountings_message() -> Message:
    return encode_tf_static(MOUNTINGS, T0_NS, T0_NS)


def drive(scans: int, first: int = 0) -> list[Message]:
    """Mountings, then scans and odometry in turn."""
    messages = [mountings_message()]
    for index in range(first, first + scans):
        messages += [odometry_message(index), scan_message(index)]
    return messages


def write_file(
    path: Path, messages: Iterable[Message], sync_every: int = 50, finish: bool = True
) -> list[Message]:
    """A file as the recorder writes it, synced (so a chunk ended) every so many messages."""
    written = list(messages)
    file = McapFile(path, written[0].log_ns)
    file.write_metadata("config", {"vehicle": "test"})
    for count, message in enumerate(written, start=1):
        file.write(message)
        if count % sync_every == 0:
            file.sync()
    if finish:
        file.finish()
    else:
        file.abandon()
    return written


def events_of(*paths: Path) -> list[dict[str, Any]]:
    """The events of a recording."""
    return [json.loads(decode_event(m.payload)) for m in Recording(paths).messages(["/events"])]


def read_back(path: Path) -> list[tuple[str, int, bytes]]:
    """Topic, log time and payload of every message, by rosbags."""
    with AnyReader([path]) as reader:
        return [(connection.topic, log_ns, bytes(data)) for connection, log_ns, data in reader.messages()]


def as_read(messages: Iterable[Message]) -> list[tuple[str, int, bytes]]:
    """What read_back is to give: by log time, in the order written where that is equal."""
    return sorted(((f"/{m.channel}", m.log_ns, m.payload) for m in messages), key=lambda row: row[1])
