"""What a scan costs the mapper, by number of beams, matching and updating apart."""

import math

import numpy as np

from drivers.frames import NO_INTENSITY, LaserScan, OdometrySample
from service.geometry.se2 import SE2
from service.mapper.profiles import MappingConfig, build_mapper, warm_up
from service.offline.replay import StageTimes
from simulators.truth import LMS100, LaserTruth, Ride
from simulators.worlds import build_world

DRIVE_S = 30.0
MOUNTING = SE2(0.2, 0.0, 0.0)


def measure() -> list[tuple[str, float, str]]:
    warm_up()
    rows = []
    for beams, rate_hz, step_deg in ((541, 50, 0.5), (1081, 25, 0.25)):
        times = StageTimes()
        mapper = build_mapper(MappingConfig(), {"front": MOUNTING}, times)
        for frame in _drive(beams, rate_hz, step_deg):
            mapper.process(frame)
        laps_ms = {stage: np.array(laps) / 1e6 for stage, laps in times.laps_ns.items()}
        whole_ms = np.sum(list(laps_ms.values()), axis=0)
        rows += [
            (f"{beams} beams: scan p50", float(np.median(whole_ms)), "ms"),
            (f"{beams} beams: scan p99", float(np.percentile(whole_ms, 99)), "ms"),
            *((f"{beams} beams: {stage} p50", float(np.median(ms)), "ms") for stage, ms in laps_ms.items()),
            (f"{beams} beams: insert mean", float(laps_ms["insert"].mean()), "ms"),
        ]
    return rows


def _drive(beams: int, rate_hz: int, step_deg: float) -> list[LaserScan | OdometrySample]:
    """A drive through the office: scans with motion in them, and true odometry at 66 Hz, by arrival."""
    ride = Ride(build_world("office"), 0, stand_s=0.5)
    laser = LaserTruth(ride, "front", MOUNTING, LMS100, seed=1)
    period_ns = round(1e9 / rate_hz)
    beam_ns = round(period_ns * step_deg / 360.0)
    first, step = math.radians(-135.0), math.radians(step_deg)
    frames: list[LaserScan | OdometrySample] = []
    for stamp_ns in range(0, round(DRIVE_S * 1e9), period_ns):
        sweep = laser.sweep(stamp_ns, beam_ns, first, step, beams)
        arrived_ns = stamp_ns + beams * beam_ns
        frames.append(
            LaserScan(
                "front",
                stamp_ns,
                arrived_ns,
                beam_ns,
                period_ns,
                first,
                step,
                0.05,
                20.0,
                sweep.range_m,
                NO_INTENSITY,
            )
        )
    for stamp_ns in range(0, round(DRIVE_S * 1e9), 15_000_000):
        pose = ride.pose(stamp_ns)
        frames.append(
            OdometrySample(
                "base", stamp_ns, stamp_ns, pose.x_m, pose.y_m, pose.theta_rad, (0.0, 0.0, 0.0), (0.0,) * 9
            )
        )
    return sorted(frames, key=lambda frame: frame.arrived_ns)
