"""Recordings of a drive through a room, as the service makes them, to be replayed."""

import json
import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from drivers.frames import NO_INTENSITY, LaserScan, OdometrySample
from service.encoding import encode_event, encode_frame, encode_tf_static
from service.geometry.se2 import SE2
from service.recording.mcap_recorder import McapRecorder

T0_NS = 1_700_000_000_000_000_000
BEAMS = 271
CONFIG = """\
vehicle: v
sensors: {front: {type: sick_lms100, host: a, mounting: {x_m: %s}}}
recording: {directory: s}
map: {directory: m}
"""


def room_scan(stamp_ns: int, x_m: float) -> LaserScan:
    """A laser at (x, 0) in a room from -4 to 6 m by -3 to 3 m, looking along x."""
    angle = np.radians(np.linspace(-135.0, 135.0, BEAMS))
    with np.errstate(divide="ignore"):
        to_side = 3.0 / np.abs(np.sin(angle))
        to_end = np.where(np.cos(angle) > 0.0, 6.0 - x_m, 4.0 + x_m) / np.abs(np.cos(angle))
    range_m = np.minimum(to_side, to_end).astype(np.float32)
    step = math.radians(270.0) / (BEAMS - 1)
    period_ns = 20_000_000
    sweep = 0, period_ns, angle[0], step, 0.05, 20.0
    return LaserScan("front", stamp_ns, stamp_ns + period_ns, *sweep, range_m, NO_INTENSITY)


def odometry_at(k: int, x_m: float, start_ns: int = T0_NS) -> OdometrySample:
    """As it comes before scan k."""
    stamp_ns = start_ns + k * 20_000_000
    return OdometrySample("base", stamp_ns, stamp_ns + 1_000_000, x_m, 0.0, 0.0, (0.5, 0.0, 0.0), (0.0,) * 9)


RecordDrive = Callable[..., Path]


def recorder_in(folder: Path) -> RecordDrive:
    """Records half a metre a second through the room; the laser is at the base's origin."""

    def record(
        name: str = "v",
        scans: int = 40,
        config: str | None = CONFIG % 0.0,
        late: bool = False,
        start_ns: int = T0_NS,
        requests: Mapping[int, str] = MappingProxyType({}),
        rear_scans: int = 0,
        one_topic: bool = False,
        covered: Collection[int] = (),
        samples: Mapping[int, OdometrySample] = MappingProxyType({}),
        mounted: str = "front",
    ) -> Path:
        metadata = {"config": {"yaml": config}} if config is not None else {}
        recorder = McapRecorder(folder / "in", name, keep_free_bytes=0, metadata=metadata)
        recorder.start()
        recorder.put(encode_tf_static({mounted: SE2()}, start_ns, start_ns))
        for k, request in requests.items():
            log_ns = start_ns + k * 20_000_000 + 1
            recorder.put(encode_event(json.dumps({"event": request}), log_ns, log_ns))
        for k in range(scans):
            stamp_ns, x_m = start_ns + k * 20_000_000, 0.01 * k
            sample = samples.get(k, odometry_at(k, x_m, start_ns))
            recorder.put(encode_frame(sample, log_ns=stamp_ns + 1_000_000))
            scan = room_scan(stamp_ns, x_m)
            blind = replace(scan, range_m=np.full(BEAMS, np.nan, np.float32))
            recorder.put(encode_frame(blind if k in covered else scan))
            if k < rear_scans:  # arrives before the scan of the front laser, yet is the newer of the two
                rear = replace(room_scan(stamp_ns + 1_000_000, x_m), sensor="rear")
                message = encode_frame(rear, log_ns=stamp_ns + 1_500_000)
                recorder.put(replace(message, channel="front/scan") if one_topic else message)
        if late:
            log_ns = start_ns + scans * 20_000_000 + 30_000_000
            recorder.put(encode_frame(room_scan(start_ns, 0.0), log_ns=log_ns))
        (session,) = recorder.finish()
        return session

    return record
