"""Unlimited laps: memory, time per scan, error and sigma stay constant.

`CORRIDOR_SOAK_HOURS` simulated hours per world (10); a shorter run is judged in the same manner.
"""

import gc
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from drivers.frames import Frame, OdometrySample
from service.geometry.se2 import SE2
from service.mapper.mapping_session import MappingSession
from service.mapper.profiles import build_mapper, mapping_config
from simulators.truth import LMS100, LaserTruth, Ride, noise_of
from simulators.worlds import build_world
from tests.simulated import FORWARD, Laser, scans_at

HOURS = float(os.environ.get("CORRIDOR_SOAK_HOURS", "10"))
LASER = Laser(LMS100, 541, 50.0, -135.0, 0.5, every=5)  # ten scans a second: at most half a metre apart
WINDOWS = 10  # the run is divided into; the first two are the map's, whose laps are new
SETTLED = 2
FIXED_EVERY = 20  # scans


@dataclass(frozen=True)
class Window:
    rss_mb: float
    scan_ms: float  # processor time, median
    relative_time: float  # the same over that of a fixed computation beside: other programs slow both
    error_m: float  # RMSE
    sigma_m: float  # of the covariance's largest axis, median


def frames(ride: Ride, seconds: float) -> Iterator[Frame]:
    """One at a time, as none is kept: wheels before each scan, of 1 % a root metre, and the scan."""
    source = LaserTruth(ride, LASER.name, LASER.mounting, LASER.model, 1)
    noise = noise_of(1, "wheels", 0)
    odometry_pose, before = SE2(), ride.pose(0)
    for stamp_ns in range(0, round(seconds * 1e9), LASER.every * LASER.period_ns):
        now = ride.pose(stamp_ns)
        path = (before.inverse() @ now).log()
        sigma = 0.01 * np.sqrt(abs(path[0])) * noise.standard_normal(2)
        odometry_pose, before = (
            odometry_pose @ SE2.exp(path[0] + sigma[0], path[1], path[2] + 0.5 * sigma[1]),
            now,
        )
        yield OdometrySample("base", stamp_ns, stamp_ns, *odometry_pose, (0.0, 0.0, 0.0), (0.0,) * 9)
        yield from scans_at(source, LASER, stamp_ns, [1])


def windows(world: str, seconds: float) -> Iterator[Window]:
    ride = Ride(build_world(world), 0, 0.5)
    first = ride.pose(0).inverse()
    session = MappingSession(lambda: build_mapper(mapping_config({}), {LASER.name: FORWARD}), [LASER.name])
    took_ms, fixed_ms, off_m, sigma_m, ends_ns = [], [], [], [], seconds * 1e9 / WINDOWS
    for frame in frames(ride, seconds):
        began_ns = time.thread_time_ns()
        output = session.process(frame)
        if output is None:
            continue
        ended_ns = time.thread_time_ns()
        took_ms.append((ended_ns - began_ns) / 1e6)
        if len(took_ms) % FIXED_EVERY == 0:
            compute()
            fixed_ms.append((time.thread_time_ns() - ended_ns) / 1e6)
        away = (first @ ride.pose(output.stamp_ns)).inverse() @ output.pose_map_base
        off_m.append(np.hypot(away.x_m, away.y_m))
        sigma_m.append(np.sqrt(np.linalg.eigvalsh(output.covariance[:2, :2])[-1]))
        session.changed_tiles()  # as a publisher takes them
        if output.stamp_ns + LASER.every * LASER.period_ns >= ends_ns:
            gc.collect()
            yield Window(
                _resident_mb(),
                float(np.median(took_ms)),
                float(np.median(took_ms) / np.median(fixed_ms)),
                float(np.sqrt(np.mean(np.square(off_m)))),
                float(np.median(sigma_m)),
            )
            took_ms, fixed_ms, off_m, sigma_m, ends_ns = [], [], [], [], ends_ns + seconds * 1e9 / WINDOWS


def compute() -> None:
    """Always the same, as a scan of the mapper in its kinds of work: interpreted calls and small arrays."""
    points, pose = np.linspace(-5.0, 5.0, 1082).reshape(-1, 2), SE2()
    for k in range(40):
        pose = pose @ SE2.exp(0.1, 0.0, 0.01 * k)
        np.floor(points @ np.array([[0.8, -0.6], [0.6, 0.8]]) / 0.05).astype(np.int64).sum()


def _resident_mb() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


@pytest.mark.soak
@pytest.mark.timeout(12 * 3600)
@pytest.mark.parametrize("world", ["office", "mall"])
def test_laps_change_neither_memory_nor_time_a_scan_nor_error_nor_sigma(world: str):
    seen = []
    for window in windows(world, HOURS * 3600.0):
        seen.append(window)
        print(f"{world}, {HOURS * len(seen) / WINDOWS:g} h: {window}", flush=True)
    settled = seen[SETTLED:]
    reference = settled[0]
    for window in settled:
        assert window.rss_mb < 1.03 * reference.rss_mb
        assert window.relative_time < 1.05 * reference.relative_time
        assert window.error_m < 1.2 * reference.error_m + 0.005
        assert window.sigma_m < 1.2 * reference.sigma_m + 0.001
