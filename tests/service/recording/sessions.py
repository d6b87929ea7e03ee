"""Messages and files that the tests of the recording share."""

import threading
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from rosbags.highlevel import AnyReader

from drivers.frames import NO_INTENSITY, LaserScan, OdometrySample
from service.encoding import Message, encode_frame, encode_tf_static
from service.geometry.se2 import SE2
from service.recording.mcap_file import McapFile

T0_NS = 1_763_719_200_000_000_000  # 2025-11-21 10:00:00 UTC
PLENTY = 1 << 40  # bytes free on a disk
PERIOD_NS = 20_000_000  # 50 scans a second
MOUNTINGS = {"front": SE2(0.2, 0.0, 0.3)}


def scan_message(index: int, sensor: str = "front", beams: int = 541) -> Message:
    """Scan `index` of a 50 Hz laser; noisy, so it does not compress to nothing."""
    ranges = np.random.default_rng(index).uniform(1.0, 20.0, beams).astype(np.float32)
    stamp_ns = T0_NS + index * PERIOD_NS
    return encode_frame(
        LaserScan(
            sensor=sensor,
            stamp_ns=stamp_ns,
            arrived_ns=stamp_ns + 5_000_000,
            beam_interval_ns=27_778,
            scan_period_ns=PERIOD_NS,
            first_angle_rad=-2.3,
            angle_step_rad=0.0087,
            range_min_m=0.05,
            range_max_m=25.0,
            range_m=ranges,
            intensity=NO_INTENSITY,
        )
    )


def odometry_message(index: int) -> Message:
    stamp_ns = T0_NS + index * PERIOD_NS + 1_000_000
    pose = (0.01 * index, 0.0, 0.001 * index)
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


def read_back(path: Path) -> list[tuple[str, int, bytes]]:
    """Topic, log time and payload of every message, by rosbags."""
    with AnyReader([path]) as reader:
        return [(connection.topic, log_ns, bytes(data)) for connection, log_ns, data in reader.messages()]


def as_read(messages: Iterable[Message]) -> list[tuple[str, int, bytes]]:
    """What read_back is to give: by log time, in the order written where that is equal."""
    return sorted(((f"/{m.channel}", m.log_ns, m.payload) for m in messages), key=lambda row: row[1])


def wait_until(condition: Callable[[], bool], seconds: float = 10.0) -> None:
    """Wait for another thread's doing; ten milliseconds between looks."""
    pause = threading.Event()
    for _ in range(round(seconds * 100)):
        if condition():
            return
        pause.wait(0.01)
    raise AssertionError(f"not within {seconds} s")
