"""What the default profile costs: a scan, a whole recording, hours in a stored map, a start."""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from drivers.frames import Frame, OdometrySample
from service.geometry.se2 import SE2
from service.mapper.profiles import build_mapper, mapping_config
from simulators.trajectory import Follow, Leg, Limits, plan_drive
from simulators.worlds import WORLDS
from simulators.worlds.mall import mall
from tests.accuracy.driving import WHEELS, Trip
from tests.accuracy.recorded import FR079
from tests.accuracy.relocalisation import mapped
from tests.bench import start_up
from tests.papers.report import Row, Section
from tests.simulated import LMS100_50HZ, UTM30LX_40HZ, drive

CORRIDOR = Path(sys.executable).with_name("corridor")  # as installed
LAP_RATE_HZ = 5.0
HOURS = 24.0
BLOCK = [(22.0, 0.0), (22.0, 30.0), (-5.0, 30.0), (-5.0, 0.0), (0.0, 0.0)]  # seen from the mall's start


def scans(seeds: Sequence[int]) -> Section:
    rows = []
    for what, world, laser, bounds in (
        ("1081 beams, ring", "ring", UTM30LX_40HZ, (0.5, 0.8, 2.0, 10.0)),
        ("1081 beams, office", "office", UTM30LX_40HZ, (0.5, 0.8, 2.0, 10.0)),
        ("541 beams, office", "office", LMS100_50HZ, (0.3, None, None, None)),
    ):
        spent = [done.scan_ms for _, done in Trip(WORLDS[world], laser, 40.0).runs(seeds)]
        for name, percent, bound in zip(("p50", "p95", "p99", "max"), (50, 95, 99, 100), bounds, strict=True):
            values = [float(np.percentile(ms, percent)) for ms in spent]
            rows.append(Row("", f"{what}: {name}", values, "ms", at_most=bound, digits=2))
    return Section(
        "A scan",
        "One scan through the whole mapper: prediction, deskew, match, sub-maps, shown map. Processor time "
        "of the thread, so that other load of the machine counts less.",
        rows,
    )


def recording(seeds: Sequence[int]) -> Section:
    """A process of its own, for its peak memory."""
    source = FR079 / "fr079.mcap"
    if not source.exists():
        return Section("Replay", f"Left out: {source} is not there; set CORRIDOR_SHARED.")
    factors, peaks = [], []
    for _ in seeds:
        with tempfile.TemporaryDirectory() as folder:
            command = [str(CORRIDOR), "replay", str(source), "--out", folder]
            subprocess.run(command, check=True, capture_output=True)
            summary = json.loads((Path(folder) / "summary.json").read_text())
        factors.append(float(summary["realtime_factor"]))
        peaks.append(float(summary["peak_rss_mb"]))
    return Section(
        "Replay of Freiburg 079",
        "1061 s of driving, the finish included, by wall clock.",
        [
            Row("", "times real time", factors, "times", at_least=100.0, digits=0),
            Row("", "peak memory", peaks, "MB", at_most=350.0, digits=0),
        ],
    )


def localised(seeds: Sequence[int]) -> Section:
    """A vehicle that drives the same lap for hours, in a map of it that stays as it is."""
    legs: list[Leg] = [Follow(BLOCK, corner_radius_m=1.5)]
    limits = Limits(speed_mps=3.0, acceleration_mps2=1.0, lateral_mps2=1.2)
    world = replace(mall(), drive=plan_drive(SE2(), legs, limits, repeats=True))
    lap_s = world.drive.duration_s
    laser = replace(LMS100_50HZ, rate_hz=LAP_RATE_HZ)
    mountings = {laser.name: laser.mounting}
    begin, _ = mapped(drive(world, laser, 1.2 * lap_s, 1, WHEELS, stand_s=0.0).frames, mountings)
    mapper = build_mapper(mapping_config({"mode": "localization"}), mountings, begin_in=begin)
    lap = drive(world, laser, lap_s, 2, WHEELS, stand_s=0.0).frames
    laps = round(HOURS * 3600.0 / lap_s)
    memory_mb, not_ok = [], 0
    for number in range(laps):
        for frame in _laps_later(lap, number, round(lap_s * 1e9)):
            output = mapper.process(frame)
            while mapper.graph.waiting:
                mapper.apply_result()
            not_ok += output is not None and output.state != "ok" and number > 0
        memory_mb.append(_memory_mb())
    grown = memory_mb[-1] / memory_mb[laps // 5]
    return Section(
        "Localised for hours",
        f"{HOURS:.0f} h, {laps} laps around a block of the mall at {LAP_RATE_HZ:.0f} scans a second, in the "
        f"map of one lap ({len(begin.graph)} key frames), searches for loops included. Memory: at the end, "
        "against that after a fifth.",
        [
            Row("", "memory, against that after a fifth", [grown], "times", 1.05, digits=3),
            Row("", "memory", [memory_mb[-1]], "MB", digits=0),
            Row("", "scans not `ok`, from the second lap on", [float(not_ok)], "scans", digits=0),
        ],
    )


def _laps_later(lap: Sequence[Frame], laps: int, lap_ns: int) -> Iterator[Frame]:
    """The frames of a lap, so many laps later: odometry counts on from lap to lap."""
    last = next(frame for frame in reversed(lap) if isinstance(frame, OdometrySample))
    a_lap, before = SE2(last.x_m, last.y_m, last.theta_rad), SE2()
    for _ in range(laps):
        before @= a_lap
    for frame in lap:
        later = {"stamp_ns": frame.stamp_ns + laps * lap_ns, "arrived_ns": frame.arrived_ns + laps * lap_ns}
        if isinstance(frame, OdometrySample):
            at = before @ SE2(frame.x_m, frame.y_m, frame.theta_rad)
            yield replace(frame, x_m=at.x_m, y_m=at.y_m, theta_rad=at.theta_rad, **later)
        else:
            yield replace(frame, **later)


def start(seeds: Sequence[int]) -> Section:
    times = [{what: value for what, value, _ in start_up.measure()} for _ in seeds[:2]]
    bounds = {"warm": 1.5, "cold": 12.0}
    rows = [
        Row("", what, [took[what] for took in times], "s", at_most=bounds[cache], digits=1)
        for cache in bounds
        for what in times[0]
        if cache in what
    ]
    return Section("Start", "From `corridor run` to the first pose at a subscriber.", rows)


def _memory_mb() -> float:
    """Resident, of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20
