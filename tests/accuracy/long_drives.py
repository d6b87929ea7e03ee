"""Kilometres of corridors with few scans, and wheels that slip."""

import gc
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from drivers.frames import OdometrySample
from service.mapper.profiles import mapping_config
from simulators.disturbances import Slip
from simulators.truth import noise_of
from simulators.world import Plan, Point, World
from tests.accuracy.driving import Errors
from tests.accuracy.terrain import COARSE, driven_along, walls_with_doors
from tests.papers.report import Row, Section
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
SLIP_WAY, SLIP_TURN = (0.0, 1.6), (0.7, 1.3)  # scales of what the wheels roll
LAST_S = 60.0


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
    way: list[Point] = []
    for row in range(ROWS + 1):
        ends = (0.0, east_m) if row % 2 == 0 else (east_m, 0.0)
        way += [(x_m, depth_m * row) for x_m in ends]
    for column in range(COLUMNS, -1, -1):
        ends = (north_m, 0.0) if (COLUMNS - column) % 2 == 0 else (0.0, north_m)
        way += [(length_m * column, y_m) for y_m in ends]
    there = [way[0], *(b for a, b in pairwise(way) if a != b)]
    return driven_along("corridors", plan, there, SPEED_MPS)


def slipping(world: World, seed: int) -> Wheels:
    """Wheels that slip now and then, each SLIP_EACH_M in the mean."""
    noise = noise_of(seed, "slips", 0)
    count = round(world.drive.length_m / SLIP_EACH_M)
    begins_s = np.sort(noise.uniform(0.0, world.drive.duration_s, count)).tolist()
    slips = tuple(
        Slip(at_s, at_s + noise.uniform(*SLIP_S), noise.uniform(*SLIP_WAY), noise.uniform(*SLIP_TURN))
        for at_s in begins_s
    )
    return Wheels(slips=slips)


def thinned_drive(seed: int) -> Drive:
    world = begun_at(corridors(np.random.default_rng(seed)), heading_rad(seed))
    made = drive(world, THINNED, world.drive.duration_s, seed, slipping(world, seed))
    odometry = [frame for frame in made.frames if isinstance(frame, OdometrySample)]
    left_out = {id(frame) for k, frame in enumerate(odometry) if k % ODOMETRY_EACH}
    return replace(made, frames=[frame for frame in made.frames if id(frame) not in left_out])


def lost_at_end(done: Run) -> float:
    """Scans of the last LAST_S."""
    since_ns = done.outputs[-1].stamp_ns - round(LAST_S * 1e9)
    return float(sum(o.state == "lost" and o.stamp_ns >= since_ns for o in done.outputs))


def thinned(seeds: Sequence[int]) -> Section:
    errors, at_end, scan_ms = Errors(), [], []
    for seed in seeds:
        made = thinned_drive(seed)
        done = run_session(mapping_config(), made)
        errors.add(made, done)
        at_end.append(lost_at_end(done))
        scan_ms.append(done.scan_ms)
        gc.collect()
    lost_row = Row(
        "", f"scans lost in the last {LAST_S:.0f} s", at_end, "scans", 0.0, by_worst=True, digits=0
    )
    return Section(
        "Corridors of 2 km, thinned",
        f"{COLUMNS} x {ROWS} blocks of {BLOCK_M[0]:.0f} x {BLOCK_M[1]:.0f} m, each corridor driven along "
        f"once at {SPEED_MPS} m/s; a scan of 181 beams over 180 deg each 1.5 s, a pose of odometry each 0.3 "
        f"s, with wheels that slip each {SLIP_EACH_M:.0f} m in the mean, for {SLIP_S[0]} to {SLIP_S[1]} s.",
        [
            lost_row,
            *errors.rows("", "lost_percent", "ate_mm", "end_mm"),
            errors.wrong_row("thinned"),
            Row("", "a scan, p95", [float(np.percentile(ms, 95)) for ms in scan_ms], "ms", digits=1),
            Row("", "a scan, longest", [float(ms.max()) for ms in scan_ms], "ms", digits=0),
        ],
    )
