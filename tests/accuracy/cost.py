"""Processor time of the default profile: a scan, a whole recording, a map that grows, a start."""

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from drivers.frames import Frame, LaserScan, OdometrySample
from service.geometry.se2 import SE2
from service.mapper.maps.occupancy import rendered_of
from service.mapper.pipeline import Mapper
from service.mapper.profiles import BeginIn, build_mapper, mapping_config
from service.outputs import MapperOutput
from simulators.trajectory import Follow, Leg, Limits, plan_drive
from simulators.world import World
from simulators.worlds import WORLDS
from simulators.worlds.mall import mall
from tests.accuracy.driving import WHEELS, Trip
from tests.accuracy.recorded import FR079
from tests.bench import start_up
from tests.papers.report import Row, Section
from tests.processes import resident_mb
from tests.simulated import LMS100_50HZ, UTM30LX_40HZ, Drive, drive

CORRIDOR = Path(sys.executable).with_name("corridor")  # as installed
LOOPS, LOOP_RATE_HZ = 100, 5.0
HOURS = 24.0
BLOCK = [(22.0, 0.0), (22.0, 30.0), (-5.0, 30.0), (-5.0, 0.0), (0.0, 0.0)]  # seen from the mall's start


def scans(seeds: Sequence[int]) -> Section:
    rows = []
    for what, world, laser, bounds in (
        ("1081 beams, ring", "ring", UTM30LX_40HZ, (0.5, 0.8, 2.0, 10.0)),
        ("1081 beams, office", "office", UTM30LX_40HZ, (0.5, 0.8, 2.0, 10.0)),
        ("541 beams, office", "office", LMS100_50HZ, (0.3, None, None, None)),
    ):
        spent = [scan_cpu_ms(made) for made in Trip(WORLDS[world], laser, 40.0).drives(seeds)]
        for name, percent, bound in zip(("p50", "p95", "p99", "max"), (50, 95, 99, 100), bounds, strict=True):
            values = [float(np.percentile(ms, percent)) for ms in spent]
            rows.append(Row(f"{what}: {name}", values, "ms", at_most=bound))
    return Section(
        "A scan",
        "One scan through the whole mapper: prediction, deskew, match, sub-maps, shown map. Processor time "
        "of the thread, so that other load of the machine counts less.",
        rows,
    )


def replay_of_fr079(seeds: Sequence[int]) -> Section:
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
            Row("times real time", factors, "times", at_least=100.0, digits=0),
            Row("peak memory", peaks, "MB", at_most=350.0),
        ],
    )


def growing_map(seeds: Sequence[int]) -> Section:
    """One long drive around a block of the mall: the cost of its first loops against that of its last."""
    world = _block_of_mall()
    lap_ns = round(world.drive.duration_s * 1e9)
    laser = replace(LMS100_50HZ, rate_hz=LOOP_RATE_HZ)
    made = drive(world, laser, LOOPS * world.drive.duration_s, 1, WHEELS, stand_s=0.0)
    mapper = build_mapper(mapping_config(), {"front": laser.mounting})
    spent: list[list[float]] = [[] for _ in range(LOOPS + 1)]
    memory_mb: dict[int, float] = {}
    for frame in made.frames:
        took_ms, output = _took_ms(mapper, frame)
        if output is not None:
            lap = frame.stamp_ns // lap_ns
            spent[lap].append(took_ms)
            if lap not in memory_mb:
                mapper.changed_tiles()
                memory_mb[lap] = resident_mb()
    early, late = (float(np.mean(np.concatenate(spent[lap : lap + 10]))) for lap in (1, LOOPS - 10))
    last = max(memory_mb)
    return Section(
        "Cost against the size of the map",
        f"{LOOPS} loops around one block of the mall, {LOOPS * world.drive.length_m / 1000.0:.1f} km at "
        f"{LOOP_RATE_HZ:.0f} scans a second. Shortened: a loop of the whole mall is 1.2 km.",
        [
            Row("a scan, loops 91 to 100 / loops 2 to 11", [late / early], "times", at_most=1.05),
            Row("a scan, loops 2 to 11", [early], "ms"),
            Row("memory, loop 100 - loop 10", [memory_mb[last] - memory_mb[10]], "MB", digits=1),
        ],
    )


def localised(seeds: Sequence[int]) -> Section:
    """A vehicle that drives the same lap for hours, in a frozen map of it."""
    world = _block_of_mall()
    lap_s = world.drive.duration_s
    laser = replace(LMS100_50HZ, rate_hz=LOOP_RATE_HZ)
    mountings = {laser.name: laser.mounting}
    mapped = build_mapper(mapping_config(), mountings)
    for frame in drive(world, laser, 1.2 * lap_s, 1, WHEELS, stand_s=0.0).frames:
        mapped.process(frame)
    graph = mapped.finish().update.saved
    begin = BeginIn(graph, rendered_of(mapped.changed_tiles()))
    old = build_mapper(mapping_config({"mode": "localization"}), mountings, begin_in=begin)
    lap = drive(world, laser, lap_s, 2, WHEELS, stand_s=0.0).frames
    laps = round(HOURS * 3600.0 / lap_s)
    tenth = max(laps // 10, 2)
    young = None  # a second one, which gets what the first gets of the last two tenths
    spent_ms: tuple[list[float], list[float]] = ([], [])
    memory_mb, not_ok, is_young_first = [], 0, False
    for number in range(laps):
        if number == laps - 2 * tenth:
            young = build_mapper(mapping_config({"mode": "localization"}), mountings, begin_in=begin)
        for frame in _laps_later(lap, number, round(lap_s * 1e9)):
            beside = _took_ms(young, frame)[0] if young is not None and is_young_first else 0.0
            spent, output = _took_ms(old, frame)
            if young is not None and not is_young_first:
                beside = _took_ms(young, frame)[0]
            is_young_first = not is_young_first
            not_ok += output is not None and output.state != "ok" and number > 0
            if output is not None and number >= laps - tenth:
                spent_ms[0].append(spent)
                spent_ms[1].append(beside)
        if young is None:
            memory_mb.append(resident_mb())
    late, early = (float(np.mean(ms)) for ms in spent_ms)
    return Section(
        "Localised for hours",
        f"{HOURS:.0f} h, {laps} laps around a block of the mall at {LOOP_RATE_HZ:.0f} scans a second, in the "
        f"map of one lap ({len(graph)} key frames), searches for loops included. A scan: of the last tenth, "
        "against the same scan in a second session that began a tenth before, the two in turn, so that both "
        "have the machine as it is. Memory: before that session began, against the end of the second tenth.",
        [
            Row("a scan, against a session a tenth as old", [late / early], "times", at_most=1.05, digits=3),
            Row("a scan", [late], "ms"),
            Row(
                "memory, against the second tenth",
                [memory_mb[-1] / memory_mb[2 * tenth - 1]],
                "times",
                at_most=1.05,
                digits=3,
            ),
            Row("memory", [memory_mb[-1]], "MB"),
            Row("scans not `ok`, from the second lap on", [float(not_ok)], "scans"),
        ],
    )


def _took_ms(mapper: Mapper[Any], frame: Frame) -> tuple[float, MapperOutput | None]:
    """Processor time of a frame, of the back end's work too."""
    began_ns = time.thread_time_ns()
    output = mapper.process(frame)
    while mapper.graph.waiting:
        mapper.apply_result()
    return (time.thread_time_ns() - began_ns) / 1e6, output


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
        Row(what, [took[what] for took in times], "s", at_most=bounds[cache])
        for cache in bounds
        for what in times[0]
        if cache in what
    ]
    return Section("Start", "From `corridor run` to the first pose at a subscriber.", rows)


def scan_cpu_ms(made: Drive) -> npt.NDArray[np.float64]:
    mapper = build_mapper(mapping_config(), {"front": LMS100_50HZ.mounting})
    spent = []
    for frame in made.frames:
        began_ns = time.thread_time_ns()
        mapper.process(frame)
        if isinstance(frame, LaserScan):
            spent.append((time.thread_time_ns() - began_ns) / 1e6)
    return np.array(spent)


def _block_of_mall() -> World:
    legs: list[Leg] = [Follow(BLOCK, corner_radius_m=1.5)]
    limits = Limits(speed_mps=3.0, acceleration_mps2=1.0, lateral_mps2=1.2)
    return replace(mall(), drive=plan_drive(SE2(), legs, limits, repeats=True))
