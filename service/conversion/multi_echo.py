"""sensor_msgs/MultiEchoLaserScan to a scan: of each beam's echoes one counts."""

from typing import cast

import numpy as np
import numpy.typing as npt

from drivers.frames import LaserScan
from service.conversion.config import Echo
from service.encoding import MULTI_ECHO_SCAN, read, scan_of_fields
from service.encoding import ros_messages as ros

Floats32 = npt.NDArray[np.float32]


def scan_of_echoes(payload: bytes, sensor: str, log_ns: int, echo: Echo = "strongest") -> LaserScan | None:
    """The scan of one echo a beam; arrived_ns becomes log_ns.

    An echo that is not within range_min and range_max counts as none. The strongest is the first of those
    with most intensity; where intensities do not come for every echo, it is the first.

    None for what no mapper can use, see service.encoding.decode_frame. Raises InputError where the bytes are
    no MultiEchoLaserScan.
    """
    m = cast(ros.sensor_msgs__msg__MultiEchoLaserScan, read(MULTI_ECHO_SCAN, payload))
    counts = np.array([len(beam.echoes) for beam in m.ranges], np.intp)
    ranges = _flat(m.ranges)
    intensities = _flat(m.intensities)
    has_intensities = len(intensities) == len(ranges) > 0
    beam = np.repeat(np.arange(len(counts)), counts)
    place = np.arange(len(ranges)) - np.repeat(np.cumsum(counts) - counts, counts)  # among its beam's echoes
    least_m, most_m = m.range_min, m.range_max if m.range_max > 0.0 else np.inf
    usable = np.isfinite(ranges) & (ranges > 0.0) & (ranges >= least_m) & (ranges < most_m)
    rank = np.where(echo == "last", -place, place).astype(np.float64)
    if echo == "strongest" and has_intensities:
        order = np.lexsort((place, -intensities.astype(np.float64)))
    else:
        order = np.argsort(rank, kind="stable")
    order = order[usable[order]]
    beams, chosen = np.unique(beam[order], return_index=True)  # the first of each beam in that order
    best = order[chosen]
    range_m, intensity = np.full(len(counts), np.nan, np.float32), np.zeros(len(counts), np.float32)
    range_m[beams] = ranges[best]
    if has_intensities:
        intensity[beams] = intensities[best]
    fields = ros.sensor_msgs__msg__LaserScan(
        m.header,
        m.angle_min,
        m.angle_max,
        m.angle_increment,
        m.time_increment,
        m.scan_time,
        m.range_min,
        m.range_max,
        range_m,
        intensity if has_intensities else np.zeros(0, np.float32),
    )
    return scan_of_fields(fields, sensor, log_ns)


def _flat(beams: list[ros.sensor_msgs__msg__LaserEcho]) -> Floats32:
    return np.concatenate([beam.echoes for beam in beams]) if beams else np.zeros(0, np.float32)
