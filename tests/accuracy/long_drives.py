"""Drives that are long: through kilometres of corridors with few scans, and round and round for an hour."""

import gc
import json
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from drivers.frames import OdometrySample
from service.mapper.profiles import mapping_config
from simulators.disturbances import Slip
from simulators.truth import noise_of
from simulators.world import Plan, Point, World
from simulators.worlds import WORLDS
from tests.accuracy.buildings import LMS100_25HZ
from tests.accuracy.cost import CORRIDOR
from tests.accuracy.driving import ate_m, lost_share, ok_and_wrong, ok_and_wrong_row
from tests.accuracy.scene_drives import STAND_S, driven
from tests.accuracy.terrain import COARSE, driven_along, walls_with_doors
from tests.papers.report import Row, Section
from tests.recorded_drive import record
from tests.simulated import Drive, Run, Wheels, begun_at, drive, heading_rad, run_session

COLUMNS, ROWS = 5, 4  # of blocks
BLOCK_M = (44.0, 30.0)  # from the middle of a corridor to that of the next
HALF_M = 1.2  # of a corridor's width
SPEED_MPS = 0.5
# Of the 10 turns a second of its mirror each fifteenth: a scan each 1.5 s.
THINNED = replace(COARSE, rate_hz=10.0, every=15)
ODOMETRY_EACH = 20  # sample is kept: one each 0.3 s
SLIP_EACH_M = 60.0
SLIP_S = (0.5, 3.0)
SLIP_DISTANCE, SLIP_TURN = (0.0, 1.6), (0.7, 1.3)  # scales of what the wheels roll
LAST_S = 60.0
BEGIN_NS = 1_795_000_000_000_000_000  # of a recording, UTC

HOUR_S = 3600.0
SETTLED_MM = 1.0  # a sigma that rises by less does not


def corridors(rng: np.random.Generator) -> World:
    """A building of 2 km of corridors, five by four blocks; each is driven along once, first those from west
    to east, then those from south to north.
    """
    plan = Plan()
    (length_m, depth_m), width_m = BLOCK_M, 2.0 * HALF_M
    east_m, north_m = COLUMNS * length_m, ROWS * depth_m
    walls_with_doors(plan, rng, (-HALF_M, -HALF_M), (east_m + HALF_M, north_m + HALF_M), -1)
    for column in range(COLUMNS):
        for row in range(ROWS):
            low = length_m * column + HALF_M, depth_m * row + HALF_M
            high = low[0] + length_m - width_m, low[1] + depth_m - width_m
            walls_with_doors(plan, rng, low, high, 1)
    path: list[Point] = []
    for row in range(ROWS + 1):
        ends = (0.0, east_m) if row % 2 == 0 else (east_m, 0.0)
        path += [(x_m, depth_m * row) for x_m in ends]
    for column in range(COLUMNS, -1, -1):
        ends = (north_m, 0.0) if (COLUMNS - column) % 2 == 0 else (0.0, north_m)
        path += [(length_m * column, y_m) for y_m in ends]
    there = [path[0], *(b for a, b in pairwise(path) if a != b)]
    return driven_along("corridors", plan, there, SPEED_MPS)


def slipping(world: World, seed: int) -> Wheels:
    """Wheels that slip now and then, each SLIP_EACH_M in the mean."""
    noise = noise_of(seed, "slips", 0)
    count = round(world.drive.length_m / SLIP_EACH_M)
    begins_s = np.sort(noise.uniform(0.0, world.drive.duration_s, count)).tolist()
    slips = tuple(
        Slip(at_s, at_s + noise.uniform(*SLIP_S), noise.uniform(*SLIP_DISTANCE), noise.uniform(*SLIP_TURN))
        for at_s in begins_s
    )
    return Wheels(slips=slips)


def thinned_drive(seed: int) -> Drive:
    world = begun_at(corridors(np.random.default_rng(seed)), heading_rad(seed))
    made = drive(world, THINNED, world.drive.duration_s, seed, slipping(world, seed))
    odometry = [frame for frame in made.frames if isinstance(frame, OdometrySample)]
    left_out = {id(frame) for k, frame in enumerate(odometry) if k % ODOMETRY_EACH}
    return replace(made, frames=[frame for frame in made.frames if id(frame) not in left_out])


@dataclass(frozen=True)
class Thinned:
    """Of one drive."""

    run: Run
    made: Drive
    summary: dict[str, Any]  # of its replay, in a process of its own

    @property
    def lost_at_end(self) -> float:
        """Scans of the last LAST_S."""
        since_ns = self.run.outputs[-1].stamp_ns - round(LAST_S * 1e9)
        return float(sum(o.state == "lost" and o.stamp_ns >= since_ns for o in self.run.outputs))


def thinned_run(seed: int) -> Thinned:
    made = thinned_drive(seed)
    done = run_session(mapping_config(), made)
    with tempfile.TemporaryDirectory() as folder:
        session = record(made.frames, {THINNED.name: THINNED.mounting}, Path(folder), BEGIN_NS)
        out = Path(folder) / "out"
        subprocess.run([str(CORRIDOR), "replay", str(session), "--out", str(out)], check=True)
        summary = json.loads((out / "summary.json").read_text())
    return Thinned(done, made, summary)


def thinned(seeds: Sequence[int]) -> Section:
    runs = []
    for seed in seeds:
        runs.append(thinned_run(seed))
        gc.collect()
    ate = [1e3 * ate_m(of.made, of.run, [o.pose_map_base for o in of.run.outputs]) for of in runs]
    return Section(
        "Corridors of 2 km, thinned",
        f"{COLUMNS} x {ROWS} blocks of {BLOCK_M[0]:.0f} x {BLOCK_M[1]:.0f} m, each corridor driven along "
        f"once at {SPEED_MPS} m/s; a scan of 181 beams over 180 deg each 1.5 s, a pose of odometry each 0.3 "
        f"s, with wheels that slip each {SLIP_EACH_M:.0f} m in the mean, for {SLIP_S[0]} to {SLIP_S[1]} s. "
        "The replay is a process of its own.",
        [
            Row(
                f"scans lost in the last {LAST_S:.0f} s",
                [of.lost_at_end for of in runs],
                "scans",
                at_most=0.0,
                by_worst=True,
            ),
            Row("scans lost", [100.0 * lost_share(of.run) for of in runs], "%"),
            ok_and_wrong_row("thinned", [ok_and_wrong(of.run) for of in runs]),
            Row("ATE live", ate, "mm"),
            Row("off at the end, as is", [1e3 * of.run.end_error[0] for of in runs], "mm"),
            Row("a scan, p95", [float(np.percentile(of.run.scan_ms, 95)) for of in runs], "ms"),
            Row("a scan, longest", [float(of.run.scan_ms.max()) for of in runs], "ms", digits=0),
            Row(
                "replay, of the time of the drive",
                [100.0 / of.summary["realtime_factor"] for of in runs],
                "%",
                at_most=1.0,
                by_worst=True,
            ),
            Row(
                "replay, peak memory",
                [float(of.summary["peak_rss_mb"]) for of in runs],
                "MB",
                at_most=350.0,
                by_worst=True,
            ),
        ],
    )


@dataclass(frozen=True)
class Laps:
    """Of one drive round and round."""

    lap_mm: npt.NDArray[np.float64]  # RMS error of each lap, as is
    sigma_rise_mm: float  # by a result of the graph, at most
    sigma_end_mm: float  # at most, in the last lap
    not_ok_percent: float
    wrong: float


def laps_run(seed: int, seconds: float) -> Laps:
    """Round the office, without its people."""
    plain = WORLDS["office"]()
    world = begun_at(driven(plain, 0.0, 1.0, seconds), heading_rad(seed))
    made = drive(world, LMS100_25HZ, seconds, seed, Wheels(), stand_s=STAND_S)
    done = run_session(mapping_config(), made)
    since_s = np.array([output.stamp_ns for output in done.outputs]) * 1e-9 - STAND_S
    return laps_of(done, world.drive.travel(since_s)[:, 0], plain.drive.length_m)


def laps_of(done: Run, path_length_m: npt.NDArray[np.float64], lap_m: float) -> Laps:
    """path_length_m: (N,) up to each output; an incomplete last lap belongs to the one before."""
    lap = np.minimum(path_length_m // lap_m, max(path_length_m[-1] // lap_m - 1.0, 0.0)).astype(int)
    square_m = (done.errors[:, :2] ** 2).sum(axis=1)
    sigma_m = np.array([np.sqrt(np.linalg.eigvalsh(o.covariance[:2, :2])[1]) for o in done.outputs])
    is_corrected = [a.pose_map_odom != b.pose_map_odom for a, b in pairwise(done.outputs)]
    return Laps(
        1e3 * np.array([np.sqrt(square_m[lap == k].mean()) for k in range(lap[-1] + 1)]),
        1e3 * float(np.diff(sigma_m)[is_corrected].max(initial=0.0)),
        1e3 * float(sigma_m[lap == lap[-1]].max()),
        100.0 * float(np.mean([output.state != "ok" for output in done.outputs])),
        ok_and_wrong(done),
    )


def hour_of_laps(seeds: Sequence[int], seconds: float = HOUR_S) -> Section:
    runs = []
    for seed in seeds:
        runs.append(laps_run(seed, seconds))
        gc.collect()
    return Section(
        "An hour of laps in one office",
        f"{seconds:.0f} s round the office at 1 m/s; LMS-100 at 25 Hz, odometry; what the graph finds comes "
        "back half a second later. Errors are live and as is. Sigma: the larger of the pose.",
        [
            Row("first lap", [of.lap_mm[0] for of in runs], "mm"),
            Row("last lap", [of.lap_mm[-1] for of in runs], "mm", at_most=20.0, by_worst=True),
            Row("worst lap", [float(of.lap_mm.max()) for of in runs], "mm"),
            Row(
                "sigma raised by a result of the graph by",
                [of.sigma_rise_mm for of in runs],
                "mm",
                at_most=SETTLED_MM,
                by_worst=True,
            ),
            Row("sigma in the last lap, at most", [of.sigma_end_mm for of in runs], "mm"),
            Row("scans not `ok`", [of.not_ok_percent for of in runs], "%"),
            ok_and_wrong_row("laps", [of.wrong for of in runs]),
        ],
    )
